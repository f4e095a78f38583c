"""Whole runs, as the command line makes them: run, resume, inspect, verify, merge, compare."""
