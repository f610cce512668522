"""Results of plug-ins: only numbers of the right shape pass, and orientations of length 1."""

import re
from decimal import Decimal
from fractions import Fraction
from itertools import count
from math import cos, inf, nan, sin, sqrt

import numpy as np
import pytest

from cloudrc.cloud.controllers import ControlOutput
from cloudrc.cloud.results import check_estimate, check_output, to_vector
from cloudrc.messages import UPRIGHT, ZERO, Odometry
from cloudrc.plugins import InvalidResultError, to_number
from tests.cloud.conftest import MS, Integrating, command, loop, telemetry

SAMPLE = Odometry(7, (1.0, 2.0, 3.0), UPRIGHT, (0.1, 0.2, 0.3), ZERO)
OUTPUT = ControlOutput((0.1, 0.2, 0.3), 0.4, ZERO, ZERO, ZERO)


class Unprintable:
    def __repr__(self):
        raise RuntimeError


NO_NUMBERS = (
    *(True, np.True_, np.array(False), None, "1.5", b"1", Decimal("1.5"), 1j, np.complex128(1)),
    *(10**400, -(10**5000), [1.0], np.array([1.0]), np.array([[1.0]]), {}, Unprintable(), float),
    *(
        np.ma.masked,
        np.ma.array([1.0, 2.0]),
        np.ma.array(2.0, mask=True),
        np.timedelta64(1, "ns"),
        np.datetime64(1, "s"),
    ),
    *(np.array(3, "m8[ns]"), np.array(np.timedelta64(1, "ns"), object)),
)


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: type(value).__name__)
def test_what_is_no_number_is_refused(value):
    for check in (
        lambda: to_number(value, "speed"),
        lambda: to_vector((0.0, value, 0.0), "velocity"),
        lambda: check_estimate(SAMPLE._replace(stamp_ns=value)),
        lambda: check_estimate(SAMPLE._replace(orientation_wxyz=(value, 0.0, 0.0, 0.0))),
        lambda: check_output(OUTPUT._replace(yaw_rate=value)),
    ):
        with pytest.raises(
            InvalidResultError, match=r"^its [^\n]* is [^\n]{,99}, which is no number$"
        ):
            check()


class Tensor:
    """A scalar of PyTorch or JAX."""

    shape = ()

    def item(self):
        return 0.5


@pytest.mark.parametrize(
    "value",
    [
        0.5,
        Fraction(1, 2),
        np.ma.array(0.5),
        np.float64(0.5),
        np.float16(0.5),
        np.array(0.5),
        Tensor(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_every_kind_of_number_becomes_a_float(value):
    assert (to_number(value, "speed"), type(to_number(value, "speed"))) == (0.5, float)
    assert to_number(np.int8(3), "speed") == to_number(3, "speed") == 3.0


@pytest.mark.parametrize("stamp_ns", [7, np.int64(7), np.uint8(7), np.array(7), np.array([7])[0]])
def test_every_kind_of_integer_is_a_stamp(stamp_ns):
    checked = check_estimate(SAMPLE._replace(stamp_ns=stamp_ns)).stamp_ns
    assert (checked, type(checked)) == (7, int)


@pytest.mark.parametrize(
    "stamp_ns", [7.0, 7.2, np.float64(7), np.float32(7), np.array(7.0), Fraction(7)]
)
def test_a_stamp_that_is_no_integer_is_refused(stamp_ns):
    with pytest.raises(InvalidResultError, match=r"^its stamp is .*, which is no integer$"):
        check_estimate(SAMPLE._replace(stamp_ns=stamp_ns))


NO_VECTORS = (
    *(None, 1.0, "123", b"abc", {1.0, 2.0, 3.0}, {1: 0.0, 2: 0.0, 3: 0.0}, ()),
    *((1.0, 2.0), (1.0, 2.0, 3.0, 4.0), np.zeros((3, 1)), np.zeros((1, 3)), np.zeros(4), count()),
)


@pytest.mark.parametrize("value", NO_VECTORS, ids=str)
def test_what_is_no_vector_is_refused(value):
    for check in (
        lambda: to_vector(value, "velocity"),
        lambda: check_estimate(SAMPLE._replace(angular_velocity_body=value)),
        lambda: check_output(OUTPUT._replace(derivative=value)),
    ):
        with pytest.raises(InvalidResultError):
            check()


@pytest.mark.parametrize("value", [None, 3, SAMPLE[:4], "odometry", np.zeros(5), np.array(1.0)])
def test_what_is_no_result_is_refused(value):
    for check in (check_estimate, check_output):
        with pytest.raises(InvalidResultError):
            check(value)


@pytest.mark.parametrize("bad", [nan, inf, -inf, 1e31])
@pytest.mark.parametrize("key", Odometry._fields)
def test_an_estimate_is_finite_and_not_huge(key, bad):
    value = getattr(SAMPLE, key)
    wrong = (*value[:-1], bad) if isinstance(value, tuple) else bad
    with pytest.raises(
        InvalidResultError, match=rf"^its {key.split('_')[0]}.* is .*{re.escape(str(bad))}"
    ):
        check_estimate(SAMPLE._replace(**{key: wrong}))


@pytest.mark.parametrize("bad", [nan, inf, -inf, 1e31])
@pytest.mark.parametrize("key", ControlOutput._fields)
def test_an_output_is_finite_and_not_huge(key, bad):
    wrong = bad if key == "yaw_rate" else (0.0, bad, 0.0)
    with pytest.raises(InvalidResultError, match=rf"^its .* is .*{re.escape(str(bad))}"):
        check_output(OUTPUT._replace(**{key: wrong}))


def of_length(length):
    return tuple(length * part for part in (cos(0.3), 0.0, sin(0.3), 0.0))


@pytest.mark.parametrize("length", [0.0, 1e-200, 0.5, 0.99, 1.01, 2.0, 1e29])
def test_an_orientation_that_is_no_rotation_is_refused(length):
    with pytest.raises(
        InvalidResultError, match=r"^its orientation \(.*\) has the length .*, not 1$"
    ):
        check_estimate(SAMPLE._replace(orientation_wxyz=of_length(length)))


@pytest.mark.parametrize("length", [0.9951, 0.999999, 1.000001, 1.0049])
def test_a_length_near_1_is_scaled_away(length):
    orientation = check_estimate(SAMPLE._replace(orientation_wxyz=of_length(length)))[2]
    assert orientation == pytest.approx(of_length(1.0))
    assert sqrt(sum(part * part for part in orientation)) == pytest.approx(1.0, abs=1e-15)


def test_what_is_right_keeps_its_bits():
    rounded = SAMPLE._replace(orientation_wxyz=of_length(1.0 + 1e-12))
    assert check_estimate(rounded) == rounded
    assert check_output(OUTPUT) == OUTPUT


@pytest.mark.parametrize("length", [0.0, 2.0])
def test_a_wrong_orientation_counts_and_is_not_recorded(length):
    class Odd(Integrating):
        def predict(self, odometry, horizon):
            return odometry._replace(orientation_wxyz=of_length(length))

        observe = commanded = applied = lambda *given: None
        reset = Integrating.reset

    a_loop = loop(predictor=Odd())
    for k in range(3):
        a_loop.observe(telemetry(100 + 10 * k), (1090 + 10 * k) * MS)
        assert command(a_loop, 1094 + 10 * k)[1].orientation_wxyz == UPRIGHT
    assert a_loop.counts["predictor_failed"] == 3
