"""Figures: plain arrays in, a matplotlib ``Figure`` out."""
