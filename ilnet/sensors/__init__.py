"""The vendors' tables, one file a vendor: elevations of the rows, columns, ranges, and where the numbers stand.

`ilnet.sensor.preset` makes sensors of them.
"""

from ilnet.sensors import hesai, ouster, robosense, velodyne
from ilnet.sensors.table import Table

__all__ = ["TABLES", "Table"]

TABLES: dict[str, Table] = velodyne.TABLES | ouster.TABLES | hesai.TABLES | robosense.TABLES
