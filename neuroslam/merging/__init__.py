"""Merging: whether two maps meet, and how two states become one."""
