import torch
from torch import nn

from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
from neuroslam.config import ViewConfig
from neuroslam.view.vision import transforms

network = nn.Sequential(
    transforms.Resize(64), nn.Conv2d(3, 32, 7, stride=4, padding=3), nn.ReLU(), nn.MaxPool2d(2)
)
view = ViewConfig(features="module", template_width=16, template_height=32, shift_match=2)
brain = NavigationBrain(BrainConfig(view=view), features=network)
for frame in open_source("drive.avi").frames(stop=20):
    brain(frame)
save_brain(brain, "brain.safetensors")
brain = load_brain("brain.safetensors", features=network)
