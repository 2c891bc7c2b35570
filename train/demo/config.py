"""Settings of the demos."""

from dataclasses import dataclass
from pathlib import Path

__all__ = ["ArmDemoConfig", "DemoConfig"]


@dataclass(frozen=True)
class DemoConfig:
    """Size of the demo; the defaults fit 2 CPU cores and 10 minutes."""

    output_dir: Path = Path("outputs/demo")
    demonstrations: int = 30
    pause_share: float = 0.45
    seed: int = 0
    offline_updates: int = 150
    steps: int = 2400
    eval_freq: int = 400
    eval_episodes: int = 20
    final_episodes: int = 50
    expert_episodes: int = 50


@dataclass(frozen=True)
class ArmDemoConfig:
    """Size of the demo; the defaults fit 2 CPU cores and 10 minutes."""

    output_dir: Path = Path("outputs/demo-arm")
    demonstrations: int = 20
    offline_updates: int = 60
    steps: int = 1800
    helped_episodes: int = 15  # in which the simulated person takes over where a try takes long
    eval_episodes: int = 40
    episode_s: float = 6.5  # simulated
    port: int = 8765
    seed: int = 0
