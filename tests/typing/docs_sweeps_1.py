from neuroslam.runs.parallel import parallel_map

parallel_map(abs, [-1, 2, -3], jobs=2)
