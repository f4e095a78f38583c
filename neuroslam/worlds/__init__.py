"""Worlds to drive through: rendered worlds, arenas, and worlds of landmarks."""
