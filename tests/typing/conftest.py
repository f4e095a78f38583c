"""The checked files are programs: they are read here, not run."""

collect_ignore_glob = ["readme.py", "own_population*.py"]
