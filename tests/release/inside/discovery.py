"""Does LeRobot find the policy, the environments and the arm by itself, and where do the packages come from?"""

from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.robots import RobotConfig
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
print("policy", "cqn" in PreTrainedConfig.get_known_choices())
print("env", "ur5e_station" in EnvConfig.get_known_choices())
print("robot", "sim_ur5e" in RobotConfig.get_known_choices())
for name in ("lerobot_cqn", "lerobot_policy_cqn", "cqn_data", "cqn_train"):
    print(name, __import__(name).__file__)
