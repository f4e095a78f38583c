"""The files beside this one are to be checked, not run: the suite collects no doctests of them."""

collect_ignore_glob = ["readme*.py", "docs_*.py", "population.py"]
