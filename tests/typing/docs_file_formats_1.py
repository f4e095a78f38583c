from neuroslam import ActivityLog, record

log = record("arena:square?minutes=1")  # or ActivityLog.open("rat")
log.names, log["grid"].shape, log.position_m.shape  # samples x cells, samples x 2
spikes = log.spikes("place", seed=1)  # Poisson
data = log.to_xarray()  # these three: pip install neuroslam[neuro]
series = log.to_pynapple()
log.to_nwb("rat.nwb", spikes=["place"])
