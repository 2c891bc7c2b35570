"""n-step returns against a loop over steps."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_cqn.n_step import n_step_return


@given(st.lists(st.floats(-2, 2), min_size=1, max_size=7), st.data())
def test_the_sum_is_that_of_a_loop(rewards: list[float], data: st.DataObject) -> None:
    window, terminal = data.draw(st.integers(1, len(rewards))), data.draw(st.booleans())
    discount = data.draw(st.floats(0.5, 1))
    total, factor = 0.0, 1.0
    for reward in rewards[:window]:
        total, factor = total + factor * reward, factor * discount
    got = n_step_return(
        torch.tensor([rewards], dtype=torch.float64), torch.tensor([[window]]), torch.tensor([[terminal]]), discount
    )
    assert [value.shape for value in got] == [(1, 1), (1, 1)]
    assert abs(float(got[0]) - total) < 1e-9
    assert abs(float(got[1]) - (0.0 if terminal else factor)) < 1e-9
