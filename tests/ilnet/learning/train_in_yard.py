"""Trains in the yard, alone or under torchrun, and keeps the gradients: `train_in_yard.py OUT`, for test_train.py."""

import os
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from conftest import yard_triangles

from ilnet.learning import train
from ilnet.world import places

out = Path(sys.argv[1])
yard = places.Place(*(part.numpy() for part in yard_triangles()), np.float32([[3, 0, 0], [-3, 2, 0]]), np.zeros(2))
gradients = []


def keep(training, optimizer):
    gradients.append({name: weight.grad.clone() for name, weight in training.named_parameters()})


train.places.town = lambda *args: yard
train.HELD_OUT, train.HELD_OUT_SCANS, train.PRECISION = {"town01": 1}, 3, "32-true"
train.PRESETS["tiny"] = train.Preset(blocks=1, crops=4, columns=32, queries=64, towns=("town01",))
train.Training.on_before_optimizer_step = keep
figures = train.train("iln-prior", "tiny", out, steps=2, features=16, heads=4)
torch.save({"gradients": gradients, "figures": figures}, out / f"rank-{os.environ.get('RANK', 'alone')}.pt")
