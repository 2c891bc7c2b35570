"""RLBench's pickles, read without RLBench and without running anything that a pickle asks for.

A pickle may name any function of Python to be called. Here only the names below are known, and each leads to a
stand-in made for this one reading, so that not even those can be changed for the rest of the process.
"""

import collections
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.errors import DataError

from .common import reading

__all__ = ["read_demo", "read_descriptions"]


def read_demo(path: Path) -> list[dict[str, Any]]:
    """Attributes of each observation of ``low_dim_obs.pkl``, in order.

    Raises:
        DataError: the file is missing, damaged, names a class that is not known, or holds something else.
    """
    demo = _read(path)
    observations = demo if isinstance(demo, list) else getattr(demo, "_observations", None)
    if not isinstance(observations, list) or not all(type(o).__name__ == "Observation" for o in observations):
        raise DataError(f"{path}: expected an RLBench Demo or a list of Observations, found {type(demo).__name__}.")
    return [dict(vars(observation)) for observation in observations]


def read_descriptions(path: Path) -> list[str]:
    """Sentences of ``variation_descriptions.pkl``; raises DataError as :func:`read_demo`."""
    sentences = _read(path)
    if not isinstance(sentences, list) or not sentences or not all(isinstance(s, str) for s in sentences):
        raise DataError(f"{path}: expected a list of sentences, found {type(sentences).__name__}; give --task=….")
    return sentences


def _read(path: Path) -> Any:
    if not path.is_file():
        raise DataError(f"{path} is missing; record or copy this episode again, or leave it out.")
    with path.open("rb") as file, reading(str(path)):
        return _Reader(file, path).load()


class _Reader(pickle.Unpickler):
    def __init__(self, file: Any, path: Path) -> None:
        super().__init__(file)
        self._path = path
        self._known = _known()

    def find_class(self, module: str, name: str) -> Any:
        known = self._known.get((module, name))
        if known is None:
            raise DataError(
                f"{self._path} asks for {module}.{name}, which is no part of an RLBench demonstration: refused, and"
                " nothing was run. Do not open this file with pickle unless you trust where it is from."
            )
        return known


def _known() -> dict[tuple[str, str], Any]:
    """Stand-ins for everything that a demonstration names, whichever NumPy wrote it."""

    class Demo:
        pass

    class Observation:
        pass

    class Array:
        """Stands for numpy.ndarray, which a pickle only names."""

    table: dict[tuple[str, str], Any] = {
        ("rlbench.demo", "Demo"): Demo,
        ("rlbench.backend.observation", "Observation"): Observation,
        ("collections", "OrderedDict"): collections.OrderedDict,
        ("builtins", "object"): object,
        ("__builtin__", "object"): object,
        ("copyreg", "_reconstructor"): _instances(Demo, Observation),
        ("copy_reg", "_reconstructor"): _instances(Demo, Observation),
        ("_codecs", "encode"): _latin1(),
        ("numpy", "ndarray"): Array,
        ("numpy", "dtype"): _dtype(),
    }
    for package in ("numpy.core", "numpy._core"):
        table |= {(f"{package}.{name}", function): made for name, function, made in _numpy(Array)}
    return table


def _numpy(array: type) -> Iterator[tuple[str, str, Callable[..., Any]]]:
    """NumPy's own helpers for pickled arrays and scalars; object arrays cannot come into being."""

    def reconstruct(kind: Any, shape: Any, typecode: Any) -> NDArray[Any]:
        if kind is not array:
            raise ValueError("expected a plain array")
        return np.ndarray.__new__(np.ndarray, shape, "b")

    def scalar(dtype: Any, data: bytes) -> Any:
        return np.frombuffer(data, dtype, 1)[0]

    def frombuffer(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
        return np.frombuffer(data, dtype).reshape(shape, order=order)

    yield "multiarray", "_reconstruct", reconstruct
    yield "multiarray", "scalar", scalar
    yield "numeric", "_frombuffer", frombuffer


def _dtype() -> Callable[..., np.dtype[Any]]:
    def dtype(code: Any, align: Any = False, copy: Any = False) -> np.dtype[Any]:
        made: np.dtype[Any] = np.dtype(str(code))
        if made.hasobject:
            raise ValueError("expected numbers, found an array of Python objects")
        return made

    return dtype


def _latin1() -> Callable[[str, str], bytes]:
    """Bytes as protocols up to 2 write them."""

    def encode(text: str, encoding: str) -> bytes:
        if encoding != "latin1":
            raise ValueError(f"expected bytes as latin1, found {encoding}")
        return text.encode("latin1")

    return encode


def _instances(*classes: type) -> Callable[[Any, Any, Any], Any]:
    """An instance as protocols 0 and 1 make it."""

    def make(kind: Any, base: Any, state: Any) -> Any:
        if kind not in classes or base is not object:
            raise ValueError("expected an RLBench object")
        return kind()

    return make
