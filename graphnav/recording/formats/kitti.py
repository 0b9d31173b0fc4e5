"""The KITTI drive that GTSAM's wheel carries among its example data, as a built-in recording.

KITTI raw recordings: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset" (2013); a car in
Karlsruhe with an OXTS RT3003. Published for non-commercial use (CC BY-NC-SA 3.0), so it is read where GTSAM
put it and never copied.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note
from graphnav.recording import Gnss, Imu, ImuNoise, Recording
from graphnav.recording.formats.axes import parse_axes_letters
from graphnav.recording.formats.registry import Format

NOMINAL_ORIGIN = (49.0, 8.4, 115.0)  # deg, deg, m: Karlsruhe; the file holds only local metres

# The file's own sigmas (0.01 m/s2, 1.75e-4 rad/s) are of an IMU at rest. Above 10 Hz, with the car moving, the samples
# scatter by 0.03, 0.06, 0.06 m/s2 and 1.3e-3, 2.9e-3, 5e-4 rad/s; the rms of the axes over 100 Hz gives these
# densities. The walks are the file's bias sigmas; the turn-on biases cover what the one stop of the drive shows.
NOISE = ImuNoise(
    gyro_noise_density=2.0e-4,
    accel_noise_density=5.0e-3,
    gyro_bias_walk=2.91e-6,
    accel_bias_walk=1.67e-4,
    gyro_bias_sigma=1.0e-3,
    accel_bias_sigma=1.0e-1,
)
# Residuals to a local quartic are 3 cm, but the positions are the OXTS' own smoothed solution, whose errors last
# longer than the second between rows: three times that.
SD = (0.1, 0.1, 0.1)  # m


def find_data_folder() -> Path:
    """The folder of the installed gtsam's example data; found without importing gtsam.

    Raises
    ------
    RecordingError
        If gtsam is not installed.
    """
    spec = importlib.util.find_spec("gtsam")
    if spec is None or not spec.submodule_search_locations:
        raise RecordingError(
            "kitti: the gtsam package, which carries this drive, is not installed", key="package.missing"
        )
    return Path(spec.submodule_search_locations[0]) / "Data"


def read_kitti(source: str | Path = "kitti") -> Recording:
    """The drive: 470 s, 3.7 km, IMU at 100 Hz, positions at 1 Hz, no attitude, no odometer, no truth.

    Raises
    ------
    RecordingError
        If gtsam's example data are not where they are expected.
    """
    folder = find_data_folder()
    files = (folder / "KittiEquivBiasedImu.txt", folder / "KittiGps_converted.txt")
    tables = []
    for file, delimiter in zip(files, (None, ","), strict=True):
        try:
            tables.append(np.loadtxt(file, skiprows=1, delimiter=delimiter))
        except (OSError, ValueError) as error:
            raise RecordingError(f"kitti: {file} cannot be read ({error})", key="file.unreadable") from None
    imu, gps = tables
    # 1.92 s without samples follow row 0 (whose own dt is its time stamp), so the drive starts at row 1.
    imu = imu[1:]
    early = gps[:, 0] < imu[0, 0]
    gps = gps[~early]
    R_bs = parse_axes_letters("FLU")
    lat, lon, h = NOMINAL_ORIGIN
    frame = LocalFrame(np.array([np.radians(lat), np.radians(lon), h]))
    return Recording(
        name="kitti",
        platform="vehicle",
        imu=Imu(imu[:, 0].copy(), imu[:, 5:8] @ R_bs.T, imu[:, 2:5] @ R_bs.T, NOISE, R_bs),
        gnss=Gnss(gps[:, 0].copy(), frame.to_llh(gps[:, 1:4]), np.tile(SD, (len(gps), 1))),
        files=files,
        remarks=(
            Note(
                "log.rows_left_out",
                f"the first IMU row, 1.92 s before the second, and {early.sum()} position before the second were "
                "dropped",
            ),
            Note(
                "log.origin",
                f"positions are local metres: {lat:g} N, {lon:g} E, {h:g} m (Karlsruhe) is only a nominal origin",
            ),
            Note(
                "log.noise",
                "position sigmas (0.1 m) and IMU noise are graphnav's own, larger than the file's, which hold at rest",
            ),
        ),
    )


FORMAT = Format(
    name="kitti",
    about="the KITTI drive carried by GTSAM's own wheel",
    recognises=lambda source: str(source) == "kitti",
    read=lambda source, _: read_kitti(source),
    builtin=True,
)
