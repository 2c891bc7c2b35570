"""The demo's report: one self-contained HTML file and the same numbers as JSON."""

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import make_pre_post_processors
from numpy.typing import NDArray

from lerobot_cqn.modeling_cqn import CQNPolicy

from ..agent import Agent
from ..envs.ur5e_station.config import UR5eStationEnv
from ..loop.evaluate import FINAL_SEED, Evaluation, evaluate, wilson_interval
from ..loop.gym_env import GymEnvironment, OneScene
from ..run.metrics import read_rows
from . import figures
from .config import DemoConfig

__all__ = ["write_report"]

Frames = list[NDArray[Any]]


def write_report(config: DemoConfig, labels: Mapping[str, str], wall_s: float) -> dict[str, Any]:
    """Write report.html and summary.json into `config.output_dir`; returns the summary."""
    out = config.output_dir
    dropped = json.loads((out / "dropped.json").read_text())[0]  # the first step of the recipe
    evaluations = {name: read_rows(out / name / "evaluations.csv") for name in labels}
    env_config = UR5eStationEnv()
    expert = run_expert(env_config, config.expert_episodes)
    steps = {"filtered": dropped["total"]["kept"], "unfiltered": dropped["total"]["steps"]}
    summary: dict[str, Any] = {
        "task": "ur5e_station / click_button, state observations",
        "config": vars(config) | {"output_dir": str(config.output_dir)},
        "versions": {name: version(name) for name in ("lerobot", "torch", "mujoco", "lerobot_policy_cqn")},
        "wall_s": round(wall_s, 1),
        "expert": expert,
        "variants": {
            name: {
                "demonstrations": labels[name],
                "steps_in_dataset": steps[name],
                "offline": _result(rows, "offline"),
                "online": _result(rows, "final"),
                "curve": [{k: _number(v) for k, v in row.items()} for row in rows],
            }
            for name, rows in evaluations.items()
        },
    }
    films = make_films(out, labels, env_config, config.pause_share)
    pictures = {
        "curves": figures.curves(evaluations, labels, expert["success_rate"]),
        "dropped": figures.dropped_steps(dropped["episodes"]),
    }
    if films:
        pictures["poster"] = figures.poster(pictures["curves"], {k: v for k, v in films.items() if "offline" not in k})
    page = _page(summary, labels, dropped, pictures, films, env_config.fps)
    _write(out / "report.html", page)
    for name, picture in pictures.items():
        (out / f"{name}.png").write_bytes(picture)
    _write(out / "summary.json", json.dumps(summary, indent=2))  # last: it marks the demo as done
    return summary


def typical_episode(out: Path, labels: Mapping[str, str], env_config: EnvConfig, look_at: int = 6) -> int:
    """First evaluation episode in which each final policy does what it does in most of the first `look_at`."""
    outcomes = [
        run_policy(out / name / "checkpoints" / "last" / "pretrained_model", env_config, FINAL_SEED, look_at).outcomes
        for name in labels
    ]
    usual = [sum(each) * 2 >= len(each) for each in outcomes]
    return next((i for i in range(look_at) if [each[i] for each in outcomes] == usual), 0)


def make_films(out: Path, labels: Mapping[str, str], env_config: EnvConfig, pause_share: float) -> dict[str, Frames]:
    """The same scene as demonstrated and as each policy handles it; nothing where the machine cannot draw."""
    seed = FINAL_SEED + typical_episode(out, labels, env_config)
    try:
        films = {"a demonstration, pauses in": film_demonstration(env_config, pause_share, seed)}
    except Exception as error:  # graphics drivers raise kinds of their own; the numbers must not be lost with them
        print(f"No films in the report, this machine cannot draw: {error}")  # noqa: T201
        return {}
    for which, folder in (("after offline training", "000000"), ("after online training", "last")):
        for name, text in labels.items():
            pretrained = out / name / "checkpoints" / folder / "pretrained_model"
            result = run_policy(pretrained, env_config, seed, 1, film=1)
            outcome = "success" if result.outcomes[0] else "out of time"
            films[f"{text}, {which}: {outcome}"] = result.frames[0]
    return films


def run_expert(config: EnvConfig, episodes: int) -> dict[str, Any]:
    """Success of the scripted operator, without pauses, on the evaluation seeds."""
    successes = sum(_operate(config, FINAL_SEED + episode, 0.0)[0] for episode in range(episodes))
    low, high = wilson_interval(successes, episodes)
    return {
        "n": episodes, "successes": successes, "success_rate": successes / episodes, "ci_low": low, "ci_high": high,
    }  # fmt: skip


def film_demonstration(config: EnvConfig, pause_share: float, seed: int) -> Frames:
    """Pictures of one demonstration with its pauses."""
    return _operate(config, seed, pause_share, film=True)[1]


def _operate(config: EnvConfig, seed: int, pause_share: float, *, film: bool = False) -> tuple[bool, Frames]:
    """One episode of the scripted operator: whether it succeeded, and pictures when asked for."""
    env = gym.make(config.gym_id, disable_env_checker=True, **config.gym_kwargs)
    station: Any = env.unwrapped
    operator, frames, ended, info = station.scripted_teleoperator(pause_share=pause_share), [], False, {}
    env.reset(seed=seed)
    operator.reset(seed)
    while not ended:
        frames += [np.asarray(env.render())] if film else []
        _, _, terminated, truncated, info = env.step(operator.act())
        ended = bool(terminated or truncated)
    frames += [np.asarray(env.render())] if film else []
    env.close()
    return bool(info["is_success"]), frames


def run_policy(pretrained: Path, env_config: EnvConfig, seed: int, episodes: int, film: int = 0) -> Evaluation:
    """Evaluation episodes of a checkpoint, the first `film` of them with pictures."""
    with redirect_stdout(io.StringIO()):  # LeRobot prints a line per loaded file
        policy = CQNPolicy.from_pretrained(pretrained)
    pre, post = make_pre_post_processors(policy.config, pretrained_path=str(pretrained))
    env = GymEnvironment(env_config, policy.config)
    result = evaluate(Agent(policy, pre, post), OneScene(env), episodes, seed=seed, film=film)
    env.close()
    return result


def _result(rows: Sequence[Mapping[str, str]], phase: str) -> dict[str, Any]:
    row = next(row for row in rows if row["phase"] == phase)
    names = ("n", "successes", "success_rate", "ci_low", "ci_high", "mean_length", "updates", "wall_s")
    return {name: _number(row[name]) for name in names}


def _number(text: str) -> Any:
    try:
        return int(text)
    except ValueError:
        try:
            return float(text)
        except ValueError:
            return text


def _write(path: Path, text: str) -> None:
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text)
    temporary.replace(path)


def _image(data: bytes, kind: str, alt: str) -> str:
    encoded = base64.b64encode(data).decode()
    return f'<img alt="{html.escape(alt)}" src="data:image/{kind};base64,{encoded}">'


_STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.7rem; margin-bottom: .2rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
.lead { font-size: 1.1rem; } .note { color: #666; font-size: .9rem; }
table { border-collapse: collapse; margin: 1rem 0; } th, td { padding: .35rem .9rem; border-bottom: 1px solid #ddd; }
td:not(:first-child), th:not(:first-child) { text-align: right; font-variant-numeric: tabular-nums; }
th { text-align: left; font-weight: 600; } img { max-width: 100%; }
.scroll { overflow-x: auto; }
@media (max-width: 40rem) { th, td { padding: .35rem .4rem; } td .note { display: block; } }
.films { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr)); gap: 1rem; }
figure { margin: 0; }
.strip { margin-bottom: 1rem; } figcaption { font-size: .9rem; color: #444; } pre { background: #f5f5f5; padding: .8rem;
overflow-x: auto; font-size: .85rem; }
"""


def _page(
    summary: Mapping[str, Any],
    labels: Mapping[str, str],
    dropped: Mapping[str, Any],
    pictures: Mapping[str, bytes],
    films: Mapping[str, Frames],
    fps: int,
) -> str:
    variants, total, config = summary["variants"], dropped["total"], summary["config"]
    best, worst = variants["filtered"]["online"], variants["unfiltered"]["online"]
    rows = [("scripted expert, no pauses", "", "", _cell(summary["expert"]))]
    for name, text in labels.items():
        v = variants[name]
        rows.append((text, str(v["steps_in_dataset"]), _cell(v["offline"]), _cell(v["online"])))
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    film_html = "".join(
        f"<figure>{_image(figures.animation(frames, fps), 'webp', name)}"
        f"<figcaption>{html.escape(name)} ({len(frames) - 1} steps)</figcaption></figure>"
        for name, frames in films.items()
    )
    strips = "".join(
        f"<figure class='strip'><figcaption>{html.escape(name)}</figcaption>"
        f"{_image(figures.film_strip(frames), 'png', name)}</figure>"
        for name, frames in films.items()
    )
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width"><title>CQN demo</title><style>{_STYLE}</style></head><body>
<h1>From paused demonstrations to a policy</h1>
<p class="lead">{config["demonstrations"]} scripted demonstrations of pressing a button, {total["share"]:.0%} of their
time steps pauses. With the pauses dropped, CQN succeeds in <b>{best["success_rate"]:.0%}</b> of {best["n"]} evaluation
episodes; with the pauses left in, in <b>{worst["success_rate"]:.0%}</b>. Same seeds, same settings, one run each.</p>
<div class="scroll"><table>
<tr><th>demonstrations</th><th>steps</th><th>after offline</th><th>after online</th></tr>{body}</table></div>
<p class="note">Success over evaluation episodes of the deterministic policy, 95 % Wilson interval in brackets. The
scripted expert is evaluated on the same seeds. One training run per variant: the interval is that of the evaluation,
not of training.</p>
<h2>Learning</h2>{_image(pictures["curves"], "png", "success rate over environment steps")}
<p class="note">{config["offline_updates"]} offline updates, then {config["steps"]} control steps online with one update
each; {summary["wall_s"] / 60:.1f} minutes for recording, filtering and both
trainings.</p>
<h2>What the filter dropped</h2>{_image(pictures["dropped"], "png", "dropped time steps per demonstration")}
<p class="note">{total["steps"]} time steps recorded, {total["kept"]} kept. A step is a pause when no joint moved by
more than the threshold since the last kept step; gripper changes and the last step are always kept.</p>
<h2>What it looks like</h2><p class="note">One scene, the first in which each final policy does what it does in most
of its first six evaluation episodes.</p><div class="films">{film_html}</div>
<h2>The same, frame by frame</h2>{strips}
<h2>Do it again</h2><pre>rm -r {html.escape(config["output_dir"])} &amp;&amp; make demo
source .venv/bin/activate
lerobot-eval --policy.path={html.escape(config["output_dir"])}/filtered/checkpoints/last/pretrained_model \\
  --env.type=ur5e_station --env.task=click_button --eval.n_episodes=50 --eval.batch_size=5 \\
  --policy.device=cpu</pre>
</body></html>
"""


def _cell(result: Mapping[str, Any]) -> str:
    return (
        f"{result['success_rate']:.2f} <span class='note'>({result['successes']}/{result['n']}, "
        f"{result['ci_low']:.2f}-{result['ci_high']:.2f})</span>"
    )
