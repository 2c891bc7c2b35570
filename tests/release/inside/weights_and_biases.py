"""A Weights & Biases run that stays on this machine."""

import sys
from pathlib import Path

from cqn_train.run.metrics import start_wandb
from lerobot_cqn.errors import CQNError

try:
    start_wandb("probe", "probe", {"a": 1}, "offline")({"updates/loss": 0.5})
except CQNError as error:
    print(error)
    sys.exit(2)

import wandb

wandb.finish()
assert list(Path("wandb").glob("offline-run-*/*.wandb")), "no run was written"
print("an offline run")
