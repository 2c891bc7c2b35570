"""Virtual arms as they are switched on: ports, what is between them and under them, and whose hands are on them."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from lerobot_cqn.errors import ConfigError

from .arm import assembled
from .cameras import CameraServer
from .chain import Chain
from .demonstrator import Demonstrator
from .port import VirtualPort
from .table import Table

__all__ = ["SERVED", "Bench", "BenchConfig"]

SERVED = ("front", "wrist")


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is switched on.

    Attributes:
        links: arms ("follower", "leader") with the names of their ports, None: only the system's own.
        task: of a table under the follower; None: no table. spread_m: how far from the middle its things lie, 0 to
            0.04 m; None: as usual.
        numbered: motors with the ids 1 to 6; else as delivered.
        speed: seconds at the table in a real one, 0.1 to 8.
        pause_share: of a demonstration, 0 to 0.9.
        cameras: port of pictures by `SERVED`, None: no pictures. size: their height and width, pixels; fps: 1 to 60.
        seed: of motors, scenes and hands.

    Raises:
        ConfigError: a value out of range.
    """

    links: Mapping[str, Path | None]
    task: str | None = None
    spread_m: float | None = None
    numbered: bool = True
    speed: float = 1.0
    pause_share: float = 0.3
    cameras: int | None = None
    size: tuple[int, int] = (120, 160)
    fps: float = 15.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("spread", self.spread_m, 0.0, 0.04), ("speed", self.speed, 0.1, 8.0), ("fps", self.fps, 1, 60),
            ("cameras", self.cameras, 1, 65535), ("seed", self.seed, 0, 2**31),
        ):  # fmt: skip
            if value is not None and not low <= value <= high:
                raise ConfigError(f"--{name}={value}: expected {low} to {high}.")
        if self.task is None and (self.cameras is not None or self.spread_m is not None):
            raise ConfigError("--cameras and --spread need something to look at: give --task as well.")
        for arm, link in self.links.items():
            if link is not None and (link.exists() or link.is_symlink()):
                raise ConfigError(f"--{arm}={link} exists: give a name that is free, or none.")
            if link is not None and not link.parent.is_dir():
                raise ConfigError(f"--{arm}={link}: there is no folder {link.parent}.")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What is switched on.

    Attributes:
        ports: by arm; table: under the follower, where there is one; demonstrator: whose hand is on the leader there.
    """

    ports: Mapping[str, VirtualPort]
    table: Table | None
    demonstrator: Demonstrator | None

    def chain(self, arm: str) -> Chain:
        """Motors of an arm."""
        return self.ports[arm].chain

    def at_table(self) -> tuple[Table, Demonstrator]:
        """Table, and who demonstrates there. Raises ConfigError where there is none, or no leader."""
        if self.table is None or self.demonstrator is None:
            raise ConfigError("This needs a table and both arms: start with --task.")
        return self.table, self.demonstrator

    @classmethod
    @contextmanager
    def on(cls, config: BenchConfig) -> Iterator["Bench"]:
        """Switch everything on, and off at the end. Raises ConfigError where something is missing or taken."""
        with ExitStack() as stack:
            table = None if config.task is None else Table(config.task, config.seed, config.spread_m)
            chains = {
                arm: assembled(
                    config.seed + len(arm), numbered=config.numbered, body=table if arm == "follower" else None,
                    speed=config.speed,
                )
                for arm in config.links
            }  # fmt: skip
            demonstrator = None
            if table is not None:
                stack.callback(table.close)
                if "leader" in chains:
                    table.shows(chains["leader"].servos)
                    demonstrator = Demonstrator(table, chains["leader"], config.pause_share, config.seed)
                    stack.callback(demonstrator.stop)
                if config.cameras is not None:
                    stack.enter_context(CameraServer(table, SERVED, config.cameras, config.size, config.fps))
            ports = {arm: stack.enter_context(VirtualPort(chains[arm], link)) for arm, link in config.links.items()}
            yield cls(ports=ports, table=table, demonstrator=demonstrator)
