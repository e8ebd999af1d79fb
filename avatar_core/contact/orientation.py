"""Rotation of tools, from the orientations that a step is given.

The rotation vector of a period is twice the vector part of q_now q_before*, with the sign of the
shorter rotation. It is exact to second order in the angle, 4 % too short at 1 rad. Friction moves
the contact point with it; a punch leans by the direction of its shaft. An orientation of zero is
none: the tool has not turned, and stands along the surface's normal.
"""

from __future__ import annotations

from typing import Any

from avatar_core.common.jit import inlined

_KNOWN = 0.5  # least square of a quaternion, 1 if there is an orientation


def composed(frame: Any, orientation: Any) -> tuple[Any, Any, Any, Any]:
    """Return an orientation, given in an inner frame, in the outer one. Real-time safe.

    Orientations are quaternions x y z w, of numbers or of arrays.
    """
    i, j, k, w = frame
    x, y, z, s = orientation
    return (
        w * x + i * s + j * z - k * y,
        w * y + j * s + k * x - i * z,
        w * z + k * s + i * y - j * x,
        w * s - i * x - j * y - k * z,
    )


@inlined
def turn_tools(model, data):  # type: ignore[no-untyped-def]
    """Compute the rotation of each tool in this period, and the direction of its shaft."""
    if not (model.friction.on or model.tilt.on):
        return
    for t in range(data.tip.shape[0]):
        now, before = data.orientation[t], data.before[t]
        known = _square(now) > _KNOWN
        for d in range(3):
            data.spin[t, d] = data.axis[t, d] = 0.0
        if known and _square(before) > _KNOWN:
            _set_spin(before, now, data.spin[t])
        if known and model.tilt.on:
            _turn(model.tilt.shaft, now, data.axis[t])
        for i in range(4):
            before[i] = now[i]


@inlined
def _square(q):  # type: ignore[no-untyped-def]
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]


@inlined
def _set_spin(before, now, spin):  # type: ignore[no-untyped-def]
    """Set the rotation vector from one orientation to another [rad]."""
    a, b, c, d = before[0], before[1], before[2], before[3]
    i, j, k, w = now[0], now[1], now[2], now[3]
    twice = 2.0 if a * i + b * j + c * k + d * w >= 0.0 else -2.0
    spin[0] = twice * (d * i - w * a - j * c + k * b)
    spin[1] = twice * (d * j - w * b - k * a + i * c)
    spin[2] = twice * (d * k - w * c - i * b + j * a)


@inlined
def _turn(vector, q, turned):  # type: ignore[no-untyped-def]
    """Turn a vector of a tool's frame into the frame of its orientation."""
    x, y, z = vector[0], vector[1], vector[2]
    i, j, k, w = q[0], q[1], q[2], q[3]
    a, b, c = 2.0 * (j * z - k * y), 2.0 * (k * x - i * z), 2.0 * (i * y - j * x)
    turned[0] = x + w * a + j * c - k * b
    turned[1] = y + w * b + k * a - i * c
    turned[2] = z + w * c + i * b - j * a
