"""Without any extra: a tiny policy learns once, is saved, and acts the same when LeRobot's factory has loaded it."""

import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()

from cqn_train.replay.buffer import Replay  # noqa: E402
from cqn_train.replay.episode import Episode  # noqa: E402
from lerobot_cqn.configuration_cqn import CQNConfig  # noqa: E402
from lerobot_cqn.learner import Learner  # noqa: E402
from lerobot_cqn.modeling_cqn import CQNPolicy  # noqa: E402
from lerobot_cqn.processor_cqn import make_cqn_pre_post_processors  # noqa: E402

folder = Path(sys.argv[1])
config = CQNConfig(
    preset="laptop_state", device="cpu", hidden_dim=16, feature_dim=8,
    input_features={"observation.state": PolicyFeature(FeatureType.STATE, (2,))},
    output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
)  # fmt: skip
policy = CQNPolicy(config)
replay = Replay(config.settings.frame_stack, config.settings.n_step, config.settings.discount)
rng = np.random.default_rng(0)
state = rng.normal(size=(9, 2)).astype(np.float32)
action = rng.uniform(-1, 1, (8, 2)).astype(np.float32)
replay.add(
    Episode(
        low_dim=state,
        pixels=(),
        action=action,
        reward=np.eye(1, 8, 7, dtype=np.float32)[0],
        terminated=True,
        success=True,
    ),
    demo=True,
)

before = [parameter.clone() for parameter in policy.parameters()]
Learner(policy.model).update(replay.sample(4, 4, rng))
assert any(not torch.equal(old, new) for old, new in zip(before, policy.parameters(), strict=True)), "nothing learned"

policy.save_pretrained(folder)
for pipeline in make_cqn_pre_post_processors(config):
    pipeline.save_pretrained(folder)

loaded_config = PreTrainedConfig.from_pretrained(folder)
loaded = get_policy_class(loaded_config.type).from_pretrained(folder, config=loaded_config)
preprocessor, _ = make_pre_post_processors(loaded_config, pretrained_path=str(folder))
policy.eval()
loaded.eval()
observation = preprocessor({"observation.state": torch.zeros(2)})
assert torch.equal(policy.select_action(dict(observation)), loaded.select_action(dict(observation))), "acts otherwise"
print("one update, saved, loaded by LeRobot, same action")
