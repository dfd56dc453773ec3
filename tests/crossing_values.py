"""Hypothesis strategies for values that can be sent, and what a value is after it was sent."""

import copy
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from tests import value_tasks as types
from tests.value_tasks import TYPES, attributes

DIMENSIONS_MAX = 8
LARGE = 70_000  # bytes: more than an argument may have inside the request
CODES = "?bBhHiIlLqQefdFD"
DTYPES = tuple(np.dtype(order + code) for code in CODES for order in "<>")


def reversed_in_memory(array: NDArray[Any]) -> NDArray[Any]:
    return array[..., ::-1] if array.ndim else array


def every_other(array: NDArray[Any]) -> NDArray[Any]:
    """A view that leaves out every other item."""
    return np.repeat(array, 2, axis=-1)[..., ::2] if array.ndim else array


def locked(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def repeated(array: NDArray[Any]) -> NDArray[Any]:
    """A view whose rows are the same memory."""
    return np.broadcast_to(array, (3, *array.shape)) if array.ndim < DIMENSIONS_MAX else array


def unaligned(array: NDArray[Any]) -> NDArray[Any]:
    return np.frombuffer(b"x" + array.tobytes(), np.uint8)[1:].view(array.dtype).reshape(array.shape)


def enlarged(array: NDArray[Any]) -> NDArray[Any]:
    """The same items again and again, until the array is a blob."""
    return np.resize(array, LARGE // array.itemsize) if array.size else array


LAYOUTS = (
    np.ascontiguousarray,
    np.asfortranarray,
    np.transpose,
    reversed_in_memory,
    every_other,
    locked,
    repeated,
    unaligned,
    enlarged,
)

any_array = st.builds(
    lambda array, layout: layout(array),
    st.sampled_from(DTYPES).flatmap(
        lambda dtype: arrays.arrays(
            dtype, arrays.array_shapes(min_dims=0, max_dims=DIMENSIONS_MAX, min_side=0, max_side=3)
        )
    ),
    st.sampled_from(LAYOUTS),
)
numpy_scalars = st.sampled_from([one for one in DTYPES if one.kind in "biuf"]).flatmap(arrays.from_dtype)
large = st.builds(
    lambda kind, item: kind(item) * (LARGE // len(item)),
    st.just(bytes),
    st.binary(min_size=1, max_size=9),
) | st.text(min_size=1, max_size=3).map(lambda text: text * LARGE)
leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.sampled_from([-(2**63), -1, 2**63 - 1, 2**63, 2**64 - 1])
    | st.floats()
    | st.sampled_from([-0.0, float("nan"), float("inf"), 5e-324])
    | st.text(max_size=20)
    | st.binary(max_size=40)
    | numpy_scalars
    | any_array
    | large
)
keys = st.text(max_size=5) | st.integers(-(2**63), 2**64 - 1)


def _branches(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    few = st.lists(inner, max_size=4)
    return (
        few
        | few.map(tuple)
        | st.dictionaries(keys, inner, max_size=4)
        | st.builds(types.Point, inner, inner)
        | st.builds(types.Child, inner, more=inner)
        | st.builds(types.Frozen, value=inner, rest=few)
        | st.builds(types.Slotted, inner, inner)
    )


# Values that can be sent.
values = st.recursive(leaves, _branches, max_leaves=12)
# Dataclasses that their constructor alone does not describe: they are sent whole, or answered onboard.
odd = (
    st.builds(types.Doubled, leaves)
    | st.builds(types.Upper, st.text("abc", max_size=5))
    | st.builds(types.Seeded, st.integers(0, 9))
    | st.builds(types.Unset, leaves)
    | st.builds(lambda point, more: _with(point, tag=more), st.builds(types.Point, leaves), leaves)
)
foreign = st.sampled_from(sorted(types.FOREIGN)).map(lambda name: types.FOREIGN[name]())


def _with(value: Any, **more: Any) -> Any:
    """The same object with more attributes than its class names."""
    for name, one in more.items():
        setattr(value, name, one)
    return value


def as_sent(value: Any) -> Any:
    """What arrives: lists for tuples, numbers for NumPy scalars, read-only arrays; the rest is the same."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return locked(np.array(value, order="C"))
    if isinstance(value, list | tuple):
        return [as_sent(one) for one in value]
    if isinstance(value, dict):
        return {key: as_sent(one) for key, one in value.items()}
    if isinstance(value, TYPES):
        sent = copy.copy(value)
        for name, one in attributes(value).items():
            object.__setattr__(sent, name, as_sent(one))
        return sent
    return value
