"""An environment of ours, made by LeRobot's factory: reset, and one step with the middle of the action space."""

import sys

from lerobot.envs.factory import make_env, make_env_config
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()

from lerobot_cqn.errors import CQNError  # noqa: E402

kind, *task = sys.argv[1:]
try:
    suites = make_env(make_env_config(kind, obs_type="state", **({"task": task[0]} if task else {})), n_envs=1)
    (vector,) = [vector for tasks in suites.values() for vector in tasks.values()]
    vector.reset(seed=0)
    space = vector.action_space
    vector.step(((space.low + space.high) / 2).astype(space.dtype))
    vector.close()
except (CQNError, ImportError) as error:
    print(error)
    sys.exit(2)
print(f"{kind}: made, reset, stepped, {space.shape[1]} action values")
