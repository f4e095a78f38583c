from pathlib import Path

from neuroslam.experiments import run_experiment

figures = {  # name of the experiment -> arguments; without them, the size of the paper
    "virtual-tour": {},  # multisession RatSLAM, Figs. 9 to 11
    "boundary-scenarios": {"minutes": 0.5},  # SLRB, Figs. 3 and 4
    "ssp-3d": {"seconds": 1.0, "n_trials": 1, "neurons": 50},  # SSP-SLAM, Fig. 10
}
for name, arguments in figures.items():
    run_experiment(name, None, Path(name), arguments=arguments)
    print(name, sorted(path.name for path in Path(name).glob("*.png")))
