"""Simulated environments, registered for LeRobot (no simulator is imported here)."""

from .aloha_config import AlohaSmallEnv
from .dmc_config import DMCEnv
from .hil_config import HilSimEnv
from .metaworld_config import MetaworldSparseEnv
from .pusht_config import PushtSmallEnv
from .registration import UR5eStationEnv
from .rlbench_config import RLBenchEnv

__all__ = [
    "AlohaSmallEnv",
    "DMCEnv",
    "HilSimEnv",
    "MetaworldSparseEnv",
    "PushtSmallEnv",
    "RLBenchEnv",
    "UR5eStationEnv",
]
