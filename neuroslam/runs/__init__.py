"""What the command line does with whole runs: make, resume, look into, merge, compare them."""
