import torch
from neuroslam.view import vision

network = vision.load().models.mobilenet_v2(weights="DEFAULT")
torch.save(network.state_dict(), "mobilenet_v2.pth")
