"""Ouster's sensors: even rows over the nominal field of view, and one with rows that are denser at the horizon.

The metadata of a unit has its own table, often a degree narrower than the nominal field of view.
"""

import numpy as np

from ilnet.sensors.table import Table, degrees

__all__ = ["TABLES"]

TABLES = {
    f"{model}-{rows}": Table(
        np.linspace(half, -half, rows), columns, limits, f"Ouster {model.upper()} data sheet: ±{half:g}°, even rows"
    )
    for model, half, columns, limits in (
        ("os0", 45.0, 1024, (0.5, 100, 120)),
        ("os1", 22.5, 1024, (0.5, 200, 250)),
        ("os2", 11.25, 2048, (1.0, 400, 500)),
    )
    for rows in (32, 64, 128)
} | {
    "os1-32-gradient": Table(
        degrees("""
            12.75 10.03 7.27 4.47 3.41 2.35 2.02 1.65 1.29 0.93 0.60 0.23 -0.13 -0.49 -0.83 -1.17 -1.54 -1.88 -2.24
            -2.60 -2.96 -3.65 -4.36 -5.06 -5.76 -7.17 -8.57 -9.95 -11.31 -12.66 -14.01 -15.32
        """),
        1024,
        (0.5, 200, 250),
        "metadata of a unit: ouster-lidar/ouster-sdk tests/pcaps/OS-1-32-G_v2.1.1_1024x10.json",
    ),
}
