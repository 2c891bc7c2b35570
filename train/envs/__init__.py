"""Simulated environments, registered for LeRobot (no simulator is imported here)."""

from .aloha_config import AlohaSmallEnv
from .dmc_config import DMCEnv
from .hil_config import HilSimEnv
from .metaworld_config import MetaworldSparseEnv
from .pusht_config import PushtSmallEnv
from .rlbench_config import RLBenchEnv
from .so101_config import So101SimEnv
from .ur5e_station.config import UR5eStationEnv

__all__ = [
    "AlohaSmallEnv",
    "DMCEnv",
    "HilSimEnv",
    "MetaworldSparseEnv",
    "PushtSmallEnv",
    "RLBenchEnv",
    "So101SimEnv",
    "UR5eStationEnv",
]
