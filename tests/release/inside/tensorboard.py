"""TensorBoard events are written, and TensorBoard reads them."""

import sys
from pathlib import Path

from cqn_train.run.metrics import start_tensorboard
from lerobot_cqn.errors import CQNError

folder = Path("events")
try:
    start_tensorboard(folder)({"updates/loss": 0.5, "updates/updates": 3.0})
except CQNError as error:
    print(error)
    sys.exit(2)

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # noqa: E402

events = EventAccumulator(str(folder))
events.Reload()
assert events.Scalars("updates/loss")[0].step == 3
print("an event file, read back")
