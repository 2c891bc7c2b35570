"""`cqn-virtual-so101`: virtual arms at serial ports, and a person's hands on them, told what to do line by line."""

import argparse
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from lerobot_cqn.errors import ConfigError, CQNError, one_of

from ..run.stop import StopRequest
from .arm import JOINTS, assembled, hand_sweep, hand_wave
from .chain import Fault, FaultKind
from .port import VirtualPort

__all__ = ["main"]

WAVE = {"shoulder_pan": 500.0, "shoulder_lift": 350.0, "elbow_flex": 350.0, "gripper": 400.0}  # steps
LOOK_S = 0.05
HELP = """lines on the standard input, ARM being leader or follower:
  only ARM JOINT          connect the board to one motor only, as lerobot-setup-motors asks for
  all ARM                 connect all of them again
  sweep ARM               move every joint through its range, as lerobot-calibrate asks for
  wave ARM SECONDS        move the arm by hand, as a demonstration does
  unplug ARM / plug ARM   pull the cable out and put it in again (the port may have another name then)
  fault ARM KIND [MOTOR [COUNT]]
                          let answers go wrong: silent, late, corrupt, checksum, doubled, overflow, overload, overheat
  mend ARM                end all faults
  state                   where the joints are
  quit                    switch off
Without lines the arms stay on until Ctrl-C.

  cqn-virtual-so101 --follower=/dev/ttyACM0 --leader=/dev/ttyACM1 --new"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cqn-virtual-so101`; returns 0, or 2 for an error of the user's."""
    parser = argparse.ArgumentParser(
        prog="cqn-virtual-so101", description="SO-101 arms that are none: serial ports behind which six servos answer.",
        epilog=HELP, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False,
    )  # fmt: skip
    for arm in ("follower", "leader"):
        parser.add_argument(f"--{arm}", nargs="?", const="", metavar="NAME", help="a port, also under this new name")
    parser.add_argument("--new", action="store_true", help="motors as delivered: all have the id 1")
    given = parser.parse_args(arguments)
    names = {arm: getattr(given, arm) for arm in ("follower", "leader") if getattr(given, arm) is not None}
    if not names:
        names = {"follower": "", "leader": ""}
    try:
        with ExitStack() as stack:
            ports = {arm: stack.enter_context(_port(arm, name, new=given.new)) for arm, name in names.items()}
            should_stop = stack.enter_context(StopRequest())
            for arm, port in ports.items():
                print(f"{arm}: {port.link or port.name}", flush=True)  # noqa: T201
            off = threading.Event()
            threading.Thread(target=_lines, args=(ports, off), daemon=True).start()
            while not should_stop() and not off.wait(LOOK_S):
                pass
    except CQNError as error:
        print(f"cqn-virtual-so101: error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    return 0


def _port(arm: str, name: str, *, new: bool) -> VirtualPort:
    link = Path(name) if name else None
    if link is not None and (link.exists() or link.is_symlink()):
        raise ConfigError(f"--{arm}={name} exists: give a name that is free, or none.")
    if link is not None and not link.parent.is_dir():
        raise ConfigError(f"--{arm}={name}: there is no folder {link.parent}.")
    return VirtualPort(assembled(len(arm), numbered=not new), link)


def _lines(ports: dict[str, VirtualPort], off: threading.Event) -> None:
    for line in sys.stdin:
        words = line.split()
        if words == ["quit"]:
            off.set()
            return
        try:
            said = _obey(ports, words) if words else ""
        except (CQNError, OSError) as error:
            said = f"error: {error}"
        if said:
            print(said, flush=True)  # noqa: T201


def _obey(ports: dict[str, VirtualPort], words: Sequence[str]) -> str:
    """Do what a line says; returns what to answer. Raises ConfigError for a line that cannot be understood."""
    verb, *rest = words
    if verb == "state":
        return "\n".join(
            f"{arm}: " + ", ".join(f"{j} {s.shaft:.0f}" for j, s in zip(JOINTS, port.chain.servos, strict=True))
            for arm, port in ports.items()
        )
    if not rest or rest[0] not in ports:
        raise ConfigError(one_of("arm", rest[0] if rest else "", ports))
    port, more = ports[rest[0]], rest[1:]
    chain = port.chain
    verbs: dict[str, Callable[[], None]] = {
        "only": lambda: setattr(chain, "plugged", frozenset([_joint(more)])),
        "all": lambda: setattr(chain, "plugged", frozenset(range(len(JOINTS)))),
        "sweep": lambda: hand_sweep(chain),
        "wave": lambda: hand_wave(chain, _number(more, 0), WAVE),
        "unplug": port.unplug,
        "plug": port.plug,
        "fault": lambda: chain.faults.append(_fault(more)),
        "mend": chain.faults.clear,
    }
    if verb not in verbs:
        raise ConfigError(one_of("line", verb, [*verbs, "state", "quit"]))
    verbs[verb]()
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
