"""Trains in the yard, alone or under torchrun, and keeps the gradients: `train_in_yard.py OUT [RANK]`.

The process RANK draws batches of NaN from the second on; then the errors of all processes are kept. For test_train.py.
"""

import os
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from conftest import yard_triangles

from ilnet import data
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
rank = os.environ.get("RANK", "alone")
spoilt = sys.argv[2:] == [rank]
draw = data.ContinuousRays._draw


def draw_or_spoil(self, number):
    batch = draw(self, number)
    return batch._replace(ranges=batch.ranges * torch.nan) if spoilt and number else batch


data.ContinuousRays._draw = draw_or_spoil
try:
    figures = train.train("iln", "tiny", out, steps=2, precision="32-true", features=16, heads=4)
except ValueError as error:
    (out / f"rank-{rank}.txt").write_text(str(error))
else:
    torch.save({"gradients": gradients, "figures": figures}, out / f"rank-{rank}.pt")
