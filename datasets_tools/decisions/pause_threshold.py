"""The automatic pause threshold: how far a joint must move within a step to count as moving. Arrays only, no files.

Shapes: T time steps of one episode, J joints (gripper left out), K steps of all episodes, B bins. Units are those
of the dataset.

The motion of a step is the largest absolute joint change to the next one. Its histogram, over the logarithm, is
kept in fixed bins while episodes stream by, so a million steps need no more memory than a hundred. From it:

1. *A gap.* People move or wait; between the two modes lies a valley. Where the valley is deep, the cut goes there,
   three quarters of the way up: in a pause a trembling hand drifts, which ``pauses.keep_mask`` sees as it compares
   with the last kept step, while a cut close to the moving mode costs little, since slow motion adds up.
2. *The resolution.* An encoder shows multiples of its step; one step of change means anything from nothing to two.
   A gap narrower than that is rounding, not evidence. Where many steps show no motion at all, the cut is one and a
   half encoder steps.
3. *The noise.* Where neither decides, slow motion and sensor noise overlap. The cut is then the smallest one that is
   safely above the noise of the joints while they rest, so that it removes too little rather than too much, and
   :attr:`Suggestion.clear` is False: a person should look at the alternatives.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

__all__ = ["Alternative", "Motion", "Suggestion", "suggest"]

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

LOW, HIGH, PER_DECADE = -10, 6, 40  # of the histogram, in log10
BINS = (HIGH - LOW) * PER_DECADE
BRISK = 0.95  # quantile of the motion that stands for brisk motion
FLOOR = 1e-3  # of brisk motion; whatever is slower counts as not moving
COARSE = 1 / 3  # of brisk motion; no encoder is coarser
NO_SIGN = 1e-2  # of brisk motion, at most, where nothing else gives a threshold
BLUR, BLUR_FEW = 0.06, 0.3  # decades, standard deviation of the smoothing: at least; times steps ** -0.2
DEEP = 0.15  # of the lower mode's height: a valley below this is clean
MIN_STILL, MIN_MOVING, MIN_STEPS = 0.03, 0.05, 8  # shares of the steps, and number of them, that make a mode
PLACE = 0.75  # position of the cut in the gap, 0 at the still mode and 1 at the moving one
TICKS, MIN_TICKS = 1.5, 20  # encoder steps; how often a single one is seen where there are any
WINDOW = 8  # steps, for the noise
NOISE = 6.0  # standard deviations; a difference of two readings has 1.4, the largest of many joints some 3 of those
QUIET = 0.5  # quantile of the noise over the windows at rest
CAREFUL = 0.1  # share of the steps that goes at most, where nothing separates pauses from motion
LADDER = (1.0, 2.0, 5.0)


@dataclass(frozen=True)
class Alternative:
    """A threshold one could choose, > 0, and the share of steps, [0, 1], whose motion is below it."""

    threshold: float
    share: float


@dataclass(frozen=True)
class Suggestion:
    """A threshold and where it comes from.

    Attributes:
        threshold: > 0, in the unit of the joints; a step whose motion is smaller is still.
        reason: how it was decided, one sentence.
        clear: whether the recording leaves no doubt; else a person should compare the alternatives.
        share: of the steps whose motion is below the threshold, [0, 1].
        steps: K, number of steps looked at.
        unmoved: share of the steps in which no joint changes at all, [0, 1].
        edges: (B + 1,) edges of the histogram in log10 of the motion, cut to where there is something.
        counts: (B,) steps a bin; the first also holds all that are slower, unmoved ones included.
        alternatives: other thresholds, ascending, the suggested one among them.
    """

    threshold: float
    reason: str
    clear: bool
    share: float
    steps: int
    unmoved: float
    edges: Array
    counts: Counts
    alternatives: tuple[Alternative, ...]


@dataclass
class Motion:
    """Memory of all episodes: fixed histograms, however many steps there were."""

    _steps: Counts = field(default_factory=lambda: np.zeros(BINS + 1, np.int64))  # bin 0: did not move
    _joints: Counts = field(default_factory=lambda: np.zeros((0, BINS + 1), np.int64))  # changes of each joint
    _noise: Counts = field(default_factory=lambda: np.zeros((0, BINS + 1), np.int64))  # of windows at rest
    _windows: int = 0

    def add(self, joints: NDArray[np.floating]) -> None:
        """Take in one episode.

        Args:
            joints: (T, J) measured joints, the gripper left out; an episode of one step adds nothing.

        Raises:
            DataError: not finite, or another number of joints than before.
        """
        values = np.asarray(joints, dtype=np.float64)
        if values.ndim != 2 or (len(self._joints) and values.shape[1] != len(self._joints)):
            raise DataError(f"Expected (T, {len(self._joints) or 'J'}) joints, got shape {values.shape}.")
        if not np.isfinite(values).all():
            raise DataError("The joints are not finite; drop or mend this episode.")
        if not len(self._joints):
            self._joints = np.zeros((values.shape[1], BINS + 1), np.int64)
            self._noise = self._joints.copy()
        if len(values) < 2 or values.shape[1] == 0:
            return
        changes = np.abs(np.diff(values, axis=0))
        self._steps += _histogram(changes.max(axis=1))
        for joint in range(values.shape[1]):
            self._joints[joint] += _histogram(changes[:, joint])
        self._add_noise(values)

    def _add_noise(self, values: Array) -> None:
        """Scatter of each joint in the windows in which it only scatters."""
        count = len(values) // WINDOW
        self._windows += count
        if count == 0:
            return
        windows = values[: count * WINDOW].reshape(count, WINDOW, -1)
        # Second differences forget position and speed; those of white noise have six times its variance.
        scatter = np.sqrt((np.diff(windows, n=2, axis=1) ** 2).mean(axis=1) / 6)
        half = WINDOW // 2
        drift = np.abs(windows[:, half:].mean(axis=1) - windows[:, :half].mean(axis=1))
        at_rest = (np.ptp(windows, axis=1) <= 5 * scatter) & (drift <= 1.5 * scatter)
        for joint in range(values.shape[1]):
            self._noise[joint] += _histogram(scatter[at_rest[:, joint], joint])

    def brisk_changes(self) -> Array:
        """(J,) change of each joint within a step that only one in twenty of its changes exceeds; 0: never moved."""
        return np.array([_quantile(counts[1:], BRISK) for counts in self._joints])

    def suggest(self) -> Suggestion:
        """Decide; without any step that moves, the threshold is a formality."""
        moving = int(self._steps[1:].sum())
        if moving == 0:
            nothing = "No joint ever moves, so every threshold is as good." if self._steps[0] else "There are no steps."
            return self._suggestion(1e-3, nothing, clear=False)
        brisk = _quantile(self._steps[1:], BRISK)
        tick = self._tick(brisk * FLOOR)
        tick = tick if tick <= COARSE * brisk else 0.0  # a motion at one speed looks like an encoder's step
        floor = max(brisk * FLOOR, 1.25 * tick)
        gap = _gap(self._steps, floor)
        if gap is not None:
            low, high = gap
            cut = low ** (1 - PLACE) * high**PLACE
            below = f"up to {low:.2g}" if low > floor * 1.01 else "nothing to speak of"
            return self._suggestion(
                cut,
                f"Steps fall into two groups with a gap between: pauses move a joint by {below}, motion by {high:.2g}"
                " and more.",
                clear=True,
            )
        noise = self._noise_level()
        if tick > 0 and self._share(1.25 * tick) >= MIN_STILL and TICKS * tick >= NOISE * noise:
            return self._suggestion(
                TICKS * tick,
                f"The encoders show no change smaller than {tick:.2g}; the cut is one and a half of that, since"
                " a single encoder step may be rounding.",
                clear=self._share(tick / 2) >= MIN_STILL,
            )
        careful = max(TICKS * tick, NOISE * noise)
        tenth = _quantile(self._steps[1:], CAREFUL, below=int(self._steps[0]))
        most = max(TICKS * tick, tenth, brisk * FLOOR)
        if careful > most:
            return self._suggestion(
                most,
                f"No gap separates pauses from slow motion, and resting joints are noisy (about {noise:.2g}); the cut"
                " takes the slowest tenth of the steps, too little rather than too much.",
                clear=False,
            )
        if careful > brisk * FLOOR:
            source = f"the noise of resting joints (about {noise:.2g})" if careful > TICKS * tick else "rounding"
            return self._suggestion(
                careful,
                f"No gap separates pauses from slow motion; the cut is just above {source}, which removes too little"
                " rather than too much.",
                clear=False,
            )
        return self._suggestion(
            min(NO_SIGN * brisk, most),
            f"No sign of pauses; the cut is at most a hundredth of brisk motion ({brisk:.2g} a step).",
            clear=False,
        )

    def _suggestion(self, threshold: float, reason: str, *, clear: bool) -> Suggestion:
        cut = _round(threshold)
        total = int(self._steps.sum())
        used = np.flatnonzero(self._steps[1:])
        first = max(int(used[0]), int(used[-1]) - 4 * PER_DECADE) if len(used) else 0
        last = int(used[-1]) + 1 if len(used) else PER_DECADE
        counts = self._steps[1 + first : 1 + last].copy()
        counts[0] = self._steps[: 2 + first].sum()
        scale = 10.0 ** np.floor(np.log10(cut))
        ladder = {_round(scale * decade * rung) for decade in (0.1, 1.0, 10.0) for rung in LADDER}
        near = {value for value in ladder if 1.25 < max(value / cut, cut / value) < 5.5}
        return Suggestion(
            threshold=cut,
            reason=reason,
            clear=clear,
            share=self._share(cut),
            steps=total,
            unmoved=float(self._steps[0] / max(1, total)),
            edges=LOW + np.arange(first, last + 1) / PER_DECADE,
            counts=counts,
            alternatives=tuple(Alternative(t, self._share(t)) for t in sorted(near | {cut})),
        )

    def _share(self, threshold: float) -> float:
        """Share of steps below a threshold, to the nearest bin (6 %)."""
        return float(self._steps[: 1 + _bin(threshold)].sum() / max(1, self._steps.sum()))

    def _tick(self, floor: float) -> float:
        """Largest encoder step among the joints that show one; 0 where changes are continuous, or finer than floor."""
        largest = 0.0
        for counts in self._joints:
            first = max(_bin(floor), 1)
            used = np.flatnonzero(counts[1 + first :])
            if not len(used) or counts[1 : 1 + first].sum() > 0.05 * counts[1:].sum():
                continue
            tick = 10 ** (LOW + (first + used[0] + 0.5) / PER_DECADE)
            one, between = _between(counts, 0.9 * tick, 1.25 * tick), _between(counts, 1.25 * tick, 1.75 * tick)
            if one >= MIN_TICKS and between <= 0.05 * one:
                largest = max(largest, tick)
        return largest

    def _noise_level(self) -> float:
        """Largest standard deviation of a resting joint; joints that rest in less than 5 % of the windows are out."""
        levels = [
            _quantile(n[1:], QUIET, below=int(n[0])) for n in self._noise if n.sum() >= max(3, 0.05 * self._windows)
        ]
        return max(levels, default=0.0)


def suggest(episodes: Iterable[NDArray[np.floating]]) -> Suggestion:
    """A threshold for all episodes together.

    Args:
        episodes: (T, J) measured joints of each, the gripper left out.

    Raises:
        DataError: not finite, or a changing number of joints.
    """
    motion = Motion()
    for joints in episodes:
        motion.add(joints)
    return motion.suggest()


def _bin(value: float) -> int:
    """Bin, 0 to BINS, whose lower edge is nearest to a value > 0."""
    return int(np.clip(round((np.log10(value) - LOW) * PER_DECADE), 0, BINS))


def _histogram(values: Array) -> Counts:
    """(BINS + 1,) counts over log10; the first holds what is 0 or below the range."""
    moved = values[values >= 10.0**LOW]
    bins = np.clip(((np.log10(moved) - LOW) * PER_DECADE).astype(np.int64), 0, BINS - 1)
    counts = np.bincount(bins + 1, minlength=BINS + 1)
    counts[0] = len(values) - len(moved)
    return counts


def _between(counts: Counts, low: float, high: float) -> int:
    return int(counts[1 + _bin(low) : 1 + _bin(high)].sum())


def _quantile(counts: Counts, share: float, below: int = 0) -> float:
    """Value at a quantile of (BINS,) counts, with ``below`` more values that are 0."""
    total = below + int(counts.sum())
    position = int(np.searchsorted(below + np.cumsum(counts), share * total))
    if total == 0 or share * total <= below:
        return 0.0
    return float(10 ** (LOW + (position + 0.5) / PER_DECADE))


def _gap(steps: Counts, floor: float) -> tuple[float, float] | None:
    """Lower and upper end of the deepest valley between two modes, or None where it is not deep."""
    first = _bin(floor)
    counts = steps[1 + first :].astype(np.float64)
    counts[0] += steps[: 1 + first].sum()
    used = int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0
    if used < 3:
        return None
    blur = PER_DECADE * max(BLUR, BLUR_FEW * float(counts.sum()) ** -0.2)  # few steps leave gaps by chance
    reach = int(4 * blur)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur) ** 2)
    padded = np.concatenate([np.zeros(reach), counts[:used], np.zeros(reach)])
    density = np.convolve(padded, kernel / kernel.sum(), mode="same")[reach:-reach]
    below = np.cumsum(counts[:used])
    share, above = below / below[-1], below[-1] - below
    left, right = np.maximum.accumulate(density), np.maximum.accumulate(density[::-1])[::-1]
    lower_mode = np.minimum(left, right)
    allowed = (share >= MIN_STILL) & (share <= 1 - MIN_MOVING) & (below >= MIN_STEPS) & (above >= MIN_STEPS)
    depth = np.where(allowed, density / np.maximum(lower_mode, 1e-9), np.inf)
    lowest = int(np.argmin(depth))
    if not depth[lowest] < DEEP:
        return None
    level = max(DEEP / 2, 1.5 * depth[lowest])
    inside = depth <= level
    start = stop = lowest
    while start > 0 and inside[start - 1]:
        start -= 1
    while stop + 1 < used and inside[stop + 1]:
        stop += 1
    low, high = (10 ** (LOW + (first + edge) / PER_DECADE) for edge in (start, stop + 1))
    return float(low), float(high)


def _round(value: float) -> float:
    """Two significant digits: more would pretend."""
    return float(f"{value:.2g}")
