from neuroslam import BrainConfig, NavigationBrain
from neuroslam.config.populations import load_plugin
from neuroslam.sensors import open_source

load_plugin("visits.py")
brain = NavigationBrain(BrainConfig(cells="pose+visits", visits={"away_s": 0.5}))
for frame in open_source("world:ellipse?width=128&height=32").frames(0, 60):
    brain(frame)
print(brain.visits.visits.tolist())
print(brain.visits.counts())
