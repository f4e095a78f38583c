"""Worlds that are made: rendered ones, arenas with walks in them, landmarks to be seen."""
