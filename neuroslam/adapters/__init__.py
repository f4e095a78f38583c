"""The package's cells and worlds in the interfaces of other packages, each with its own extra."""
