"""The statistics of cqn-bench."""

import sys

import numpy as np

from cqn_train.bench.report import aggregate, check_packages
from lerobot_cqn.errors import CQNError

try:
    check_packages()
except CQNError as error:
    print(error)
    sys.exit(2)
scores = {"one": np.array([[0.9, 0.8], [0.7, 1.0]]), "other": np.array([[0.1, 0.2], [0.3, 0.0]])}
means, better = aggregate(scores)
assert means["one"][0] > means["other"][0]
assert better["other"][0] == 1.0
print("interquartile means and intervals")
