"""`kill -9` at any moment of a session at the arm: no finished episode is lost, and the same command goes on."""

import random
from pathlib import Path

import pytest

from .conftest import ARM_CAMERA, TINY_POLICY
from .test_cqn_train_kills import kill_in_phases
from .zygote import Zygote

pytest.importorskip("mujoco")
pytest.importorskip("fastapi", reason="needs the extra [page]")


@pytest.fixture
def session(cleaned_arm: Path, free_port: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Options of a session on the simulated arm, with a simulated person who answers at the page."""
    monkeypatch.setenv("CQN_PAGE_TOKEN", "a-token-of-the-test")
    return [
        *TINY_POLICY, *ARM_CAMERA, "--policy.encoder_channels=[4,8]", "--policy.shift_pixels=2",
        "--robot.type=sim_ur5e", "--robot.state=true", "--robot.speed=8",
        f"--robot.person=http://127.0.0.1:{free_port}", "--teleop.type=sim_leader", "--dataset.repo_id=local/cqn",
        f"--dataset.root={cleaned_arm}", f"--page.port={free_port}", "--operator_page", "--offline_updates=20",
        "--updates_per_episode=2", "--batch_size=4", "--demo_batch_size=4", "--steps=100000",
        "--arm.episode_s=1", "--arm.stale_s=5",
        "--save_freq=40", "--eval.freq=60", "--eval.n_episodes=1", "--eval.final_n_episodes=1", "--log_freq=1",
        "--threads=1",
    ]  # fmt: skip


@pytest.mark.real_time(reason="the arm and the person of another process live by the machine's own clock")
def test_a_session_that_is_killed_in_any_phase_goes_on(session: list[str], tmp_path: Path, processes: Zygote) -> None:
    run = tmp_path / "run"
    phases = ["beginning", "offline", "online", "saving", "evaluating"]
    kill_in_phases(run, [*session, f"--output_dir={run}"], processes, phases, random.Random(3))


@pytest.mark.slow
def test_sessions_that_are_killed_at_sixty_moments_go_on(session: list[str], tmp_path: Path, processes: Zygote) -> None:
    rng = random.Random(4)
    for number in range(5):
        run = tmp_path / f"run{number}"
        phases = ["beginning", "offline", *(rng.choice(["online", "saving", "evaluating"]) for _ in range(10))]
        kill_in_phases(run, [*session, f"--seed={number}", f"--output_dir={run}"], processes, phases, rng)
