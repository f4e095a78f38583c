from neuroslam.tuning import tune

tuning = tune("drive.avi", "tuned")
tuning.config.view.threshold, tuning.verdict
