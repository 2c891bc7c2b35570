"""`make demo-so101`: the documented way with LeRobot's own drivers and commands, on two virtual SO-101 at a table.

Setting up the motors, calibrating, recording with pauses, cleaning, training online, and driving the arm with what was
learned; a simulated person moves the leader, and answers at the operator's page. Interrupted at any moment, it goes on
where it was when started again; only the motors are then delivered, set up and calibrated anew.
"""

import json
import os
import secrets
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from ..interfaces import PAGE_TOKEN
from ..run.metrics import read_rows
from ..sim_arm.keyboard import NEXT, Terminal, own_program
from ..sim_arm.person import SimPerson
from ..virtual_so101.arm import hand_sweep
from ..virtual_so101.bench import SERVED, Bench, BenchConfig
from ..virtual_so101.joints import JOINTS
from .arm import arm_progress, arm_summary, arm_table
from .config import So101DemoConfig
from .film import FPS, Film
from .stages import DemoError, Stages, Watched, fresh, run_once

__all__ = ["main", "run_demo"]

ARMS = {"follower": ("robot", "so101_follower"), "leader": ("teleop", "so101_leader")}
LATE = "There is no status packet"  # as the motors' SDK says it
AGAIN = b"r"  # lerobot-record's key: the episode once more


class LateAnswerError(DemoError):
    """A motor's answer came after the time for which LeRobot's driver waits."""


def run_demo(config: So101DemoConfig, console: Console) -> dict[str, Any]:
    """The demo from unpacking to driving; returns what `summary.json` holds. Raises DemoError when a command fails."""
    from .figures import animation, film_strip

    stages = Stages(config.output_dir, console)
    run = config.output_dir / "run"
    for name in ("home", "calibration"):
        stages.environment[f"HF_LEROBOT_{name.upper()}"] = str((config.output_dir / name).absolute())
    with stages.timed(), Bench.on(_bench(config)) as bench:
        film = Film(bench.at_table()[0])
        for arm in ARMS:
            with console.status(f"  {arm}: motors and calibration"):
                _patiently(stages, partial(_set_up, stages, bench, arm))
        console.print("  lerobot-setup-motors and lerobot-calibrate, twice")
        data = _demonstrations(stages, config, bench, film)
        _train(stages, config, bench, data, run)
        _drive(stages, config, bench, run, film)
    (config.output_dir / "film.webp").write_bytes(animation(film.frames, FPS))
    (config.output_dir / "film.png").write_bytes(film_strip(film.frames))
    return arm_summary(stages, config, run)


def _bench(config: So101DemoConfig) -> BenchConfig:
    links = {arm: (config.output_dir / f"tty-{arm}").absolute() for arm in ARMS}
    for link in links.values():
        link.unlink(missing_ok=True)  # of a start that was killed
    return BenchConfig(
        links=links, task=config.task, spread_m=config.spread_m, numbered=False, speed=config.speed,
        pause_share=config.pause_share, cameras=config.cameras or None, fps=config.fps, seed=config.seed,
    )  # fmt: skip


def _both(bench: Bench, config: So101DemoConfig) -> list[str]:
    """Both arms, as LeRobot's commands are told: the follower's options first."""
    options = {
        arm: [f"--{what}.type={kind}", f"--{what}.port={bench.ports[arm].link}", f"--{what}.id={arm}"]
        for arm, (what, kind) in ARMS.items()
    }
    height, width = BenchConfig.size
    cameras = {
        name: {"type": "zmq", "server_address": "127.0.0.1", "port": config.cameras, "camera_name": name,
               "width": width, "height": height, "fps": config.fps}
        for name in SERVED
    }  # fmt: skip
    seen = [f"--robot.cameras={json.dumps(cameras)}"] if config.cameras else []
    return [*options["follower"], "--robot.disable_torque_on_disconnect=false", *seen, *options["leader"]]


def _command(stages: Stages, name: str, *arguments: str) -> Terminal:
    return Terminal([own_program(name), *arguments], environment=stages.environment)


@contextmanager
def _spoken(stages: Stages, name: str, command: Terminal, seconds: float = 60.0) -> Iterator[None]:
    """Talk with a command that must end well; what it said is kept as logs/name.log. Raises DemoError."""
    try:
        with suppress(ChildProcessError):  # what it said last tells why
            yield
        code = command.ends(seconds)
    except TimeoutError as error:
        command.process.kill()
        raise DemoError(str(error)) from error
    except KeyboardInterrupt:
        command.process.terminate()
        command.ends(seconds)
        raise
    finally:
        (stages.logs / f"{name}.log").write_text(command.said)
    if code and LATE in command.said:
        raise LateAnswerError(f"'{name}': {LATE}; all of it in {stages.logs / f'{name}.log'}")
    stages.check(name, code)


def _patiently(stages: Stages, attempt: Callable[[], None]) -> None:
    """Try thrice: LeRobot's drivers wait 50 ms for an answer and ask once, and the machine may be busy."""
    for left in (2, 1, 0):
        try:
            attempt()
            return
        except LateAnswerError:
            if not left:
                raise
            stages.console.print("  an answer came too late for LeRobot's driver: once more")


def _set_up(stages: Stages, bench: Bench, arm: str) -> None:
    """Number the motors of an arm one by one, and calibrate it, as a person does who has just built it."""
    what, kind = ARMS[arm]
    chain = bench.chain(arm)
    port = (f"--{what}.type={kind}", f"--{what}.port={bench.ports[arm].link}")
    setup = _command(stages, "lerobot-setup-motors", *port)
    with _spoken(stages, f"setup-{arm}", setup):
        for joint in reversed(JOINTS):
            setup.hears(f"'{joint}' motor only and press enter.")
            chain.plugged = frozenset([JOINTS.index(joint)])
            setup.press(b"\n")
            setup.hears(f"'{joint}' motor id set to {JOINTS.index(joint) + 1}")
    chain.plugged = frozenset(range(len(JOINTS)))
    kept = Path(stages.environment["HF_LEROBOT_CALIBRATION"])
    for old in kept.rglob(f"{arm}.json"):  # of an arm that is no more
        old.unlink()
    calibrate = _command(stages, "lerobot-calibrate", *port, f"--{what}.id={arm}")
    with _spoken(stages, f"calibrate-{arm}", calibrate):
        calibrate.hears("press ENTER....")
        calibrate.press(b"\n")
        calibrate.hears("Press ENTER to stop...")
        hand_sweep(chain)
        calibrate.press(b"\n")
        calibrate.hears("Calibration saved to")


def _demonstrations(stages: Stages, config: So101DemoConfig, bench: Bench, film: Film) -> Path:
    """Record demonstrations with the leader, and clean them; returns the folder of the cleaned ones."""
    raw, trimmed, clean = (config.output_dir / "data" / name for name in ("raw", "trimmed", "clean"))
    finished = stages.logs / "record.done"
    if not finished.exists():
        with stages.console.status(f"  lerobot-record: {config.demonstrations} demonstrations"):
            _patiently(stages, partial(_record, stages, config, bench, raw, film))
        finished.touch()
        stages.console.print(f"  lerobot-record: {config.demonstrations} demonstrations")
    recipe = "paper_real_world" if config.cameras else "arm_state"
    stages.run(
        "trim", "cqn-data: the leap to the leader off", trimmed, "cqn_data.cli", "trim", "--leap",
        "--repo_id=demo/raw", f"--root={raw}", "--new_repo_id=demo/trimmed", f"--new_root={trimmed}",
    )  # fmt: skip
    stages.run(
        "recipe", "cqn-data: pauses out, joint differences, bounds", clean, "cqn_data.cli", "run", recipe,
        "--repo_id=demo/trimmed", f"--root={trimmed}", "--new_repo_id=demo/clean", f"--new_root={clean}",
    )  # fmt: skip
    return clean


def _record(stages: Stages, config: So101DemoConfig, bench: Bench, raw: Path, film: Film) -> None:
    """Lead the leader through the task while lerobot-record mirrors and records it."""
    table, demonstrator = bench.at_table()
    fresh(raw)
    record = _command(
        stages, "lerobot-record", *_both(bench, config), "--dataset.repo_id=demo/raw", f"--dataset.root={raw}",
        f"--dataset.fps={config.fps}", f"--dataset.num_episodes={config.demonstrations}",
        f"--dataset.single_task={table.task.sentence}", "--dataset.episode_time_s=60", "--dataset.reset_time_s=60",
        "--dataset.push_to_hub=false", "--play_sounds=false",
    )  # fmt: skip
    with _spoken(stages, "record", record):
        demonstrator.home()
        done = 0
        while done < config.demonstrations:
            record.hears("Recording episode")
            with nullcontext() if done else film.rolling():
                done += (well := demonstrator.show())
            record.press(NEXT if well else AGAIN)
            if done < config.demonstrations:
                record.hears("Reset the environment")
                demonstrator.home()
                if not well:
                    table.lay_out()
                record.press(NEXT)


def _train(stages: Stages, config: So101DemoConfig, bench: Bench, data: Path, run: Path) -> None:
    """Online training with a person at the page and a progress bar, from the last checkpoint where there is one."""
    if any(row["phase"] == "final" for row in read_rows(run / "evaluations.csv")):
        return
    os.environ[PAGE_TOKEN] = stages.environment[PAGE_TOKEN] = os.environ.get(PAGE_TOKEN) or secrets.token_urlsafe(16)
    if (run / "checkpoints" / "last").exists():
        arguments = ["--resume=true", f"--output_dir={run}"]
    else:
        arguments = [
            "--policy.type=cqn", f"--policy.preset={'laptop_pixels' if config.cameras else 'laptop_state'}",
            "--policy.device=cpu", *_both(bench, config),
            "--dataset.repo_id=demo/clean", f"--dataset.root={data}", f"--output_dir={fresh(run)}",
            f"--seed={config.seed}", f"--offline_updates={config.offline_updates}", f"--steps={config.steps}",
            f"--eval.final_n_episodes={config.eval_episodes}", f"--arm.episode_s={config.episode_s / config.speed}",
            "--operator_page", f"--page.port={config.port}", "--threads=1", "--updates_per_episode=100",
            "--save_freq=500",
        ]  # fmt: skip
    table, demonstrator = bench.at_table()
    demonstrator.home()
    table.lay_out()
    url = f"http://127.0.0.1:{config.port}"
    person = SimPerson(table, url)
    process = stages.start("train", "cqn_train.cli", *arguments)
    stages.console.print(
        f"  watch it at the operator's page: {url}/?token={stages.environment[PAGE_TOKEN]}", soft_wrap=True
    )
    person.start()
    training = Watched(
        process=process, text="online training", total=config.steps,
        progress=partial(arm_progress, run, config.eval_episodes),
    )  # fmt: skip
    try:
        stages.watch({"train": training})
    finally:
        person.close()


def _drive(stages: Stages, config: So101DemoConfig, bench: Bench, run: Path, film: Film) -> None:
    """Drive the arm with the policy, by LeRobot's own command."""
    policy = run / "checkpoints" / "last" / "pretrained_model"
    rollout = _command(
        stages, "lerobot-rollout", f"--policy.path={policy}", *_both(bench, config)[:-3], f"--fps={config.fps}",
        "--duration=4", "--return_to_initial_position=false", "--play_sounds=false",
    )  # fmt: skip
    table, _ = bench.at_table()
    table.lay_out()
    with stages.console.status("  lerobot-rollout"), film.rolling(), _spoken(stages, "rollout", rollout):
        pass
    done = "and did the task" if table.success else "and did not do the task"
    stages.console.print(f"  lerobot-rollout drove it for 4 s {done}")


def show(summary: dict[str, Any], config: So101DemoConfig, console: Console) -> None:
    """The short table at the end."""
    arm_table(f"{config.task} on a virtual SO-101, judged by the simulated person", summary, config, console)


def main() -> int:
    """Entry of `python -m cqn_train.demo.so101`."""
    introduction = "Two SO-101 that are none, from setting up their motors to a better policy: about 15 minutes"
    return run_once("demo-so101", So101DemoConfig, introduction, run_demo, show)


if __name__ == "__main__":
    sys.exit(main())
