"""What the server of drills imports once for all programs; nothing here may start a thread."""

import importlib
import os
import pkgutil

import kornia.metrics  # noqa: F401
import torch

import nerf
import pipeline.cli.commands  # noqa: F401
import stages
import stages.sfm.colmap
import stages.train.profile
from nerf.runtime.machine_rates import Rates

torch.set_num_threads(torch.get_num_threads())
# Each training measures the machine for half a second on all cores at its end; no result depends on it.
stages.train.profile.measure_rates = lambda *_: Rates(1e10, 1e8, 1e10)
# Nor do drills cut the power.
os.fsync = lambda fd: None
# Whatever a stage imports only as it runs: half of the time of a chain as tiny as these. Last, as whoever imports this
# module passes over errors of imports.
for package in (nerf, stages):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        importlib.import_module(module.name)
