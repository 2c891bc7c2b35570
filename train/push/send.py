"""A run's policy sent to the Hub: its files and its card, in one commit."""

import shlex
from dataclasses import fields
from pathlib import Path

from huggingface_hub import constants
from huggingface_hub.utils import disable_progress_bars  # type: ignore[attr-defined]
from lerobot.utils.import_utils import register_third_party_plugins

from cqn_data.hub.client import Hub
from cqn_data.hub.files import size_of
from cqn_data.hub.readme import Readme, union
from cqn_data.hub.report import megabytes, show_dry, show_sent
from cqn_data.terminal.console import note, result
from lerobot_cqn.errors import DataError
from lerobot_cqn.hub_retry import refuse_to_start
from lerobot_cqn.model_card import ModelFacts, front_matter, write_part

from .. import envs  # noqa: F401  # registers our environments
from ..arm.devices import register_devices
from .card_facts import find_checkpoint, look
from .config import TOOL, PushConfig

__all__ = ["check_account", "push"]

README = "README.md"


def push(config: PushConfig) -> None:
    """Send the policy of a run.

    Raises:
        ConfigError: an option has a wrong form, or the policy corrects one that is on this machine only.
        DataError: there is no such checkpoint, or it cannot be loaded.
        HubError: nobody is logged in, or the Hub refused or could not be reached; it names the command that goes on.
        Interrupted: Ctrl-C while sending.
    """
    config.validate()
    register_third_party_plugins()
    register_devices()
    disable_progress_bars()  # ours shows the whole
    if not config.dry_run:
        refuse_to_start()
    found = find_checkpoint(Path(config.run), config.checkpoint)
    facts, files = look(
        found, config.repo_id, films=config.films, license=config.license, tags=tuple(config.tags),
        dataset=config.dataset,
    )  # fmt: skip
    facts.config.refuse_local_base()
    if config.dry_run:
        card = _card(facts, None)
        show_dry({**files, README: card.encode()}, card, config.repo_id)
        return
    branch = None if config.branch == "main" else config.branch
    hub = Hub(config.repo_id, again(config), branch, kind="model")
    hub.prepare(private=config.private)
    card = _card(facts, hub.text(README))
    hub.check_card(card)
    size = sum(size_of(content) for content in files.values())
    note(f"Sending {len(files)} files, {megabytes(size)}, and the card to {config.repo_id} ({hub.branch}).")
    sent = hub.send({**files, README: card.encode()}, config.message or _message(facts))
    show_sent(sent, config.repo_id, "policy")
    result(f"Use it: --policy.path={config.repo_id} in lerobot-eval, lerobot-rollout and cqn-train.")
    result(sent.url)


def check_account(repo_id: str) -> str | None:
    """Before a training that ends with a push: who is logged in, and may they. Returns a warning where nobody can tell.

    Raises HubError where the push would be refused.
    """
    refuse_to_start()
    try:
        Hub(repo_id, "the same command", kind="model").check_account()
    except ConnectionError as error:
        return f"the Hub cannot be reached now ({error}); the policy is pushed at the end, or later with cqn-push."
    return None


def again(config: PushConfig) -> str:
    """The command that pushes like this once more."""
    more = []
    for option_ in fields(config):
        value = getattr(config, option_.name)
        if option_.name in ("run", "repo_id", "dry_run") or value in (option_.default, []):
            continue
        text = f"[{', '.join(value)}]" if isinstance(value, list) else str(value)
        more.append(f"--{option_.name}={text.lower() if isinstance(value, bool) else text}")
    return shlex.join([TOOL, f"--run={config.run}", f"--repo_id={config.repo_id}", *more])


def _card(facts: ModelFacts, there: str | None) -> str:
    """The card, with what a person wrote in the one that is there; its licence and tags stay where none are given."""
    try:
        readme = Readme.read(there or "", TOOL)
    except DataError as error:
        raise DataError(f"On the Hub: {error} Mend it there.") from error
    front = front_matter(facts)
    front["license"] = facts.license or readme.front.get("license") or front["license"]
    front["tags"] = union(readme.front.get("tags"), front["tags"])
    part = write_part(facts, constants.ENDPOINT)
    card: str = readme.with_part({**readme.front, **front}, part, facts.repo_id.partition("/")[2])
    return card


def _message(facts: ModelFacts) -> str:
    if not facts.results:
        return f"{TOOL}: {facts.task}"
    last = facts.results[-1]
    return f"{TOOL}: {facts.task}, success {last.successes}/{last.n}"
