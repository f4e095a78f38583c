from neuroslam import NavigationBrain
from neuroslam.config import build_config
from neuroslam.config.populations import load_plugin
from neuroslam.sensors import open_source

load_plugin("visits.py")
brain = NavigationBrain(build_config({"cells": "pose+visits", "visits": {"away_s": 0.5}}))
for frame in open_source("world:ellipse?width=128&height=32").frames(0, 60):
    brain(frame)
print(brain.populations["visits"].tables()["visits.csv"])
print(brain.populations["visits"].counts())
