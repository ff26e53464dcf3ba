"""Velodyne's sensors.

A unit of the HDL-64E has its own calibration, a few tenths of a degree from the nominal angles.
"""

import numpy as np

from ilnet.sensors.table import RISING, Table, degrees

__all__ = ["TABLES"]

TABLES = {
    "vlp-16": Table(
        np.arange(-15.0, 16, 2), 1800, (0.5, 100, 120), "VLP-16 User Manual 63-9243 Rev. D: vertical angles", RISING
    ),
    "hdl-32e": Table(
        degrees("""
            10.67 9.33 8.00 6.67 5.33 4.00 2.67 1.33 0.00 -1.33 -2.67 -4.00 -5.33 -6.67 -8.00 -9.33 -10.67 -12.00
            -13.33 -14.67 -16.00 -17.33 -18.67 -20.00 -21.33 -22.67 -24.00 -25.33 -26.67 -28.00 -29.33 -30.67
        """),
        2170,
        (0.05, 100, 120),
        "HDL-32E User's Manual 63-9113, laser firing sequence; ros-drivers/velodyne params/32db.yaml",
    ),
    "hdl-64e": Table(
        np.concatenate((2 - np.arange(32) / 3, -8 - 5 / 6 - np.arange(32) / 2)),
        2048,
        (0.9, 120, 150),
        "HDL-64E S2 User's Manual 63-HDL64ES2: upper lasers 1/3° apart, lower ones 1/2°",
    ),
    "vlp-32c": Table(
        degrees("""
            15 10.333 7 4.667 3.333 2.333 1.667 1.333 1 0.667 0.333 0 -0.333 -0.667 -1 -1.333 -1.667 -2 -2.333 -2.667
            -3 -3.333 -3.667 -4 -4.667 -5.333 -6.148 -7.254 -8.843 -11.31 -15.639 -25
        """),
        1800,
        (0.9, 200, 250),
        "VLP-32C User Manual 63-9325 Rev. C, table 9-6; ros-drivers/velodyne config/VLP32C (ranges)",
    ),
    "vls-128": Table(
        np.concatenate(
            (
                degrees("15 11.75 9.7 8.43 7.58 6.98 6.48 6.08 5.73 5.43 5.18 4.98 4.83"),
                4.72 - 0.11 * np.arange(103),
                degrees("-6.65 -6.85 -7.15 -7.65 -8.352 -9.244 -10.346 -11.742 -13.565 -16.042 -19.582 -25"),
            )
        ),
        1800,
        (0.4, 300, 375),
        "ros-drivers/velodyne params/VLS128.yaml and config/VLS128 (ranges)",
    ),
}
