"""The safety of a haptic loop: force limits, passivity and load shedding.

Poses and forces of the contact model come in. Forces within the device's limits go out, engaged
smoothly after faults and passive in the time domain. While the machine is overloaded, fewer modes
are shown.
"""
