"""Settings of the demos."""

from dataclasses import dataclass
from pathlib import Path

__all__ = ["ArmDemoConfig", "DemoConfig", "So101DemoConfig"]


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


@dataclass(frozen=True)
class So101DemoConfig:
    """Size of the demo; the defaults fit 2 CPU cores and 15 minutes."""

    output_dir: Path = Path("outputs/demo-so101")
    task: str = "press_button"  # or cube_in_bowl
    spread_m: float = 0.01  # things lie within so far of the middle: the policy sees joints only
    demonstrations: int = 20
    pause_share: float = 0.3
    offline_updates: int = 300
    steps: int = 2400
    eval_episodes: int = 20
    episode_s: float = 8.0  # simulated
    speed: float = 2.0  # simulated seconds in a real one
    fps: int = 20  # control steps in a real second: 10 in a simulated one
    cameras: int = 0  # port of two cameras that the policy sees as well; 0: it sees joints only
    port: int = 8765
    seed: int = 0
