"""Captures as a sensor would fill them, written from scans."""

import json
import struct

import numpy as np


def vlp16_packets(scans):
    """The data packets of a VLP-16 that measures each scan (16, 1800) in one turn, azimuths falling from ahead.

    A block has the ranges of two columns. A sensor fires its lasers one after the other, which the angles of a scan do
    not know; so a decoder sees the later half of them nearer to the next column.
    """
    lasers = np.argsort([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])  # the row, from below, of each laser
    lasers = np.argsort(lasers)
    found, microseconds = [], 0
    for scan in scans:
        order = np.argsort(-scan.sensor.azimuths % (2 * np.pi))  # a VLP-16 turns clockwise
        rows = np.argsort(scan.sensor.elevations)[lasers]
        ranges = (scan.ranges.numpy()[rows][:, order].T / 0.002).round().astype(int)  # in steps of 2 mm
        strength = (
            np.zeros(ranges.shape, int)
            if scan.intensity is None
            else (scan.intensity.numpy()[rows][:, order].T * 255).round().astype(int)
        )
        turned = np.rad2deg(-scan.sensor.azimuths[order] % (2 * np.pi))
        for begin in range(0, len(order), 24):
            packet = b""
            for column in range(begin, begin + 24, 2):
                packet += struct.pack("<HH", 0xEEFF, round(turned[column] * 100) % 36000)
                for laser in range(32):
                    at = column + laser // 16, laser % 16
                    packet += struct.pack("<HB", ranges[at], strength[at])
            found.append((microseconds / 1e6, packet + struct.pack("<IBB", microseconds, 0x37, 0x22)))
            microseconds += 1333
    return found


def pcap(packets, port=2368, mtu=1480):
    """A capture file of UDP packets, each with its time [s]; long ones are fragmented."""
    file = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for number, (time, payload) in enumerate(packets):
        datagram = struct.pack(">HHHH", port, port, 8 + len(payload), 0) + payload
        for begin in range(0, len(datagram), mtu):
            part = datagram[begin : begin + mtu]
            more = 0x2000 * (begin + mtu < len(datagram))
            head = struct.pack(
                ">BBHHHBBH4s4s",
                0x45,
                0,
                20 + len(part),
                number % 65536,
                more | begin // 8,
                64,
                17,
                0,
                b"\x7f\0\0\1",
                b"\x7f\0\0\1",
            )
            frame = b"\0" * 12 + b"\x08\0" + head + part
            file += struct.pack("<IIII", int(time), round(time % 1 * 1e6), len(frame), len(frame)) + frame
    return file


def ouster_metadata(sensor, profile="RNG19_RFL8_SIG16_NIR16", nested=True):
    """The metadata file of a sensor whose rows are staggered by 0, 3, 1 and 2 pixels."""
    rows, columns = sensor.shape
    shifts = [(0, 3, 1, 2)[row % 4] for row in range(rows)]
    beams = {
        "beam_altitude_angles": np.rad2deg(sensor.elevations).tolist(),
        "beam_azimuth_angles": [360 / columns * shift for shift in shifts],
    }
    packets = {
        "columns_per_frame": columns,
        "columns_per_packet": 16,
        "pixel_shift_by_row": shifts,
        "udp_profile_lidar": profile,
    }
    unit = {"prod_line": "OS-1-64", "prod_sn": "1"}
    parts = {"beam_intrinsics": beams, "lidar_data_format": packets, "sensor_info": unit}
    return json.dumps(parts if nested else {**beams, "data_format": packets, **unit})


def ouster_packets(scans, metadata, start=100.0):
    """The packets of an Ouster sensor that measures each scan in one turn of a tenth of a second."""
    found = json.loads(metadata)
    packets = found.get("lidar_data_format") or found["data_format"]
    profile, shifts = packets["udp_profile_lidar"], packets["pixel_shift_by_row"]
    for frame, scan in enumerate(scans):
        (rows, columns), made = scan.sensor.shape, []
        millimetres = (scan.ranges.numpy() * 1000).round().astype(int)
        strength = (scan.intensity.numpy() * 255).round().astype(int)
        for number in range(columns):
            since = round(1e8 * number / columns)
            body = b""
            for row in range(rows):
                at = row, (number + shifts[row]) % columns
                far, bright = int(millimetres[at]), int(strength[at])
                if profile == "RNG15_RFL8_NIR8":
                    body += struct.pack("<HBB", far // 8, bright, 77)
                elif profile.endswith("DUAL"):  # reflectivity, then a second return that is not read
                    body += struct.pack("<IIHHHH", far | bright << 24, 12345, 300, 0, 77, 0)
                else:
                    body += struct.pack("<IBxHHxx", far, bright, 300, 77)
            time = round(start * 1e9) + round(frame * 1e8) + since
            if profile == "LEGACY":
                made.append(struct.pack("<QHHI", time, number, frame, 0) + body + struct.pack("<I", 0xFFFFFFFF))
            else:
                made.append(struct.pack("<QHH", time, number, 1) + body)
        for begin in range(0, columns, 16):
            payload = b"".join(made[begin : begin + 16])
            if profile != "LEGACY":
                payload = struct.pack("<HH28x", 1, frame) + payload + b"\0" * 32
            yield start + frame / 10 + begin / columns / 10, payload
