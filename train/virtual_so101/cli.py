"""`cqn-virtual-so101`: virtual arms at serial ports, and a person's hands on them, told what to do line by line."""

import argparse
import re
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from lerobot_cqn.errors import ConfigError, CQNError, one_of

from ..run.stop import StopRequest
from .arm import hand_sweep, hand_wave
from .bench import SERVED, Bench, BenchConfig
from .chain import Fault, FaultKind
from .joints import JOINTS
from .port import VirtualPort
from .tasks import TASKS

__all__ = ["main"]

WAVE = {"shoulder_pan": 500.0, "shoulder_lift": 350.0, "elbow_flex": 350.0, "gripper": 400.0}  # steps
AT_TABLE = ("show", "home", "scene")
LOOK_S = 0.05
HELP = """lines on the standard input, ARM being leader or follower:
  only ARM JOINT          connect the board to one motor only, as lerobot-setup-motors asks for
  all ARM                 connect all of them again
  sweep ARM               move every joint through its range, as lerobot-calibrate asks for
  wave ARM SECONDS        move the arm by hand, as a demonstration does
  show                    lead the leader through the task at the table, with pauses, and say whether it is done
  home                    lead the leader back home
  scene                   lay a new scene out; it happens by itself when the follower has come home
  unplug ARM / plug ARM   pull the cable out and put it in again (the port may have another name then)
  fault ARM KIND [MOTOR [COUNT]]
                          let answers go wrong: silent, late, corrupt, checksum, doubled, overflow, overload, overheat
  mend ARM                end all faults
  state                   where the joints are
  quit                    switch off
Without lines the arms stay on until Ctrl-C.

  cqn-virtual-so101 --follower=/dev/ttyACM0 --leader=/dev/ttyACM1 --new
  cqn-virtual-so101 --task=press_button --cameras=5555     # with a table; pictures for LeRobot's cameras of type zmq"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cqn-virtual-so101`; returns 0, or 2 for an error of the user's."""
    parser = argparse.ArgumentParser(
        prog="cqn-virtual-so101", description="SO-101 arms that are none: serial ports behind which six servos answer.",
        epilog=HELP, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False,
    )  # fmt: skip
    for arm in ("follower", "leader"):
        parser.add_argument(f"--{arm}", nargs="?", const="", metavar="NAME", help="a port, also under this new name")
    parser.add_argument("--new", action="store_true", help="motors as delivered: all have the id 1")
    parser.add_argument("--task", choices=sorted(TASKS), help="a table with this to do under the follower, in MuJoCo")
    parser.add_argument("--spread", type=float, metavar="M", help="how far from the middle its things lie, 0 to 0.04 m")
    parser.add_argument("--cameras", type=int, metavar="PORT", help=f"pictures by {' and '.join(SERVED)} at this port")
    parser.add_argument("--picture", default="160x120", metavar="WxH", help="their size in pixels (160x120)")
    parser.add_argument("--fps", type=float, default=15.0, help="pictures of each camera in a second, 1 to 60 (15)")
    parser.add_argument("--speed", type=float, default=1.0, help="seconds at the table in a real one, 0.1 to 8 (1)")
    parser.add_argument("--seed", type=int, default=0, help="of scenes and of the hand (0)")
    given = parser.parse_args(arguments)
    try:
        with ExitStack() as stack:
            bench = stack.enter_context(Bench.on(_config(given)))
            should_stop = stack.enter_context(StopRequest())
            for arm, port in bench.ports.items():
                print(f"{arm}: {port.link or port.name}", flush=True)  # noqa: T201
            if given.cameras is not None:
                said = f"type: zmq, server_address: 127.0.0.1, port: {given.cameras}, camera_name: front"
                print(f"cameras: {{{said}}}, and wrist", flush=True)  # noqa: T201
            off = threading.Event()
            threading.Thread(target=_lines, args=(bench, off), daemon=True).start()
            while not should_stop() and not off.wait(LOOK_S):
                pass
    except CQNError as error:
        print(f"cqn-virtual-so101: error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    return 0


def _config(given: argparse.Namespace) -> BenchConfig:
    """What is asked for. Raises ConfigError for values that cannot be."""
    links = {arm: getattr(given, arm) for arm in ("follower", "leader") if getattr(given, arm) is not None}
    size = re.fullmatch(r"(\d{2,3})x(\d{2,3})", given.picture)
    if size is None:
        raise ConfigError(f"--picture={given.picture}: expected width x height, as 160x120.")
    width, height = map(int, size.groups())
    return BenchConfig(
        links={arm: Path(name) if name else None for arm, name in (links or {"follower": "", "leader": ""}).items()},
        task=given.task, spread_m=given.spread, numbered=not given.new, speed=given.speed, cameras=given.cameras,
        size=(height, width), fps=given.fps, seed=given.seed,
    )  # fmt: skip


def _lines(bench: Bench, off: threading.Event) -> None:
    for line in sys.stdin:
        words = line.split()
        if words == ["quit"]:
            off.set()
            return
        try:
            said = _obey(bench, words) if words else ""
        except (CQNError, OSError) as error:
            said = f"error: {error}"
        if said:
            print(said, flush=True)  # noqa: T201


def _obey(bench: Bench, words: Sequence[str]) -> str:
    """Do what a line says; returns what to answer. Raises ConfigError for a line that cannot be understood."""
    verb, *rest = words
    ports = bench.ports
    if verb not in (*AT_TABLE, *VERBS, "state", "quit"):
        raise ConfigError(one_of("line", verb, [*AT_TABLE, *VERBS, "state", "quit"]))
    if verb in AT_TABLE:
        table, demonstrator = bench.at_table()
        if verb == "show":
            return f"show: done, {'a success' if demonstrator.show() else 'not a success'}"
        (demonstrator.home if verb == "home" else table.lay_out)()
        return f"{verb}: done"
    if verb == "state":
        return "\n".join(
            f"{arm}: " + ", ".join(f"{j} {s.shaft:.0f}" for j, s in zip(JOINTS, port.chain.servos, strict=True))
            for arm, port in ports.items()
        )
    if not rest or rest[0] not in ports:
        raise ConfigError(one_of("arm", rest[0] if rest else "", ports))
    port, more = ports[rest[0]], rest[1:]
    VERBS[verb](port, more)
    return f"{verb}: done" + (f", {port.link or port.name}" if verb == "plug" else "")


def _joint(more: Sequence[str]) -> int:
    if not more or more[0] not in JOINTS:
        raise ConfigError(one_of("joint", more[0] if more else "", JOINTS))
    return JOINTS.index(more[0])


def _number(more: Sequence[str], place: int) -> int:
    if len(more) <= place or not more[place].isdecimal():
        raise ConfigError(f"Expected a whole number in place {place + 1}, got {' '.join(more) or 'nothing'}.")
    return int(more[place])


def _fault(more: Sequence[str]) -> Fault:
    if not more or more[0] not in list(FaultKind):
        raise ConfigError(one_of("fault", more[0] if more else "", list(FaultKind)))
    motor, left = (_number(more, place) if len(more) > place else None for place in (1, 2))
    return Fault(kind=FaultKind(more[0]), motor=motor, left=left)


VERBS: dict[str, Callable[[VirtualPort, Sequence[str]], None]] = {  # what is done to an arm, with what follows its name
    "only": lambda port, more: setattr(port.chain, "plugged", frozenset([_joint(more)])),
    "all": lambda port, more: setattr(port.chain, "plugged", frozenset(range(len(JOINTS)))),
    "sweep": lambda port, more: hand_sweep(port.chain),
    "wave": lambda port, more: hand_wave(port.chain, _number(more, 0), WAVE),
    "unplug": lambda port, more: port.unplug(),
    "plug": lambda port, more: port.plug(),
    "fault": lambda port, more: port.chain.faults.append(_fault(more)),
    "mend": lambda port, more: port.chain.faults.clear(),
}
