"""The result of a scenario, and the assembly of a recording from a drive's parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.recording import Imu, Recording, Truth
from graphnav.recording.formats.writing import round_recording, write_facts, write_folder
from graphnav.simulation.aiding import GnssModel, OdometerModel
from graphnav.simulation.inertial import SimulatedImu
from graphnav.simulation.kinematics import Mount, TrueMotion, move_vehicle
from graphnav.simulation.motion import Path
from graphnav.simulation.series import BarometerModel, DualAntennaModel
from graphnav.simulation.vibration import Shake


@dataclass(frozen=True)
class Simulated:
    """A recording as its files would contain it, with truth and facts that no sensor measures."""

    recording: Recording
    truth: Trajectory  # of the IMU at the start and every sample, biases included (of the period that ends there)
    stops: Array  # (M, 2) s: the wheels do not turn
    facts: dict[str, Any] = field(default_factory=dict)  # the parameters of the simulation, for JSON
    motion: TrueMotion | None = field(default=None, repr=False)  # with the error-free samples

    def format(self) -> str:
        """The drive in words.

        Returns
        -------
        str
            One line.
        """
        imu, stopped = self.recording.imu, float(np.sum(np.diff(self.stops)))
        return (
            f"{self.recording.name}: {self.recording.duration:.1f} s, IMU at {1.0 / np.median(np.diff(imu.t)):.4g} Hz, "
            f"{format_count(len(self.stops), 'stop')} ({stopped:.1f} s)"
        )

    def write(self, folder: str | FilePath) -> list[FilePath]:
        """Write a recording folder, and `simulated.json` for the stops and facts.

        Parameters
        ----------
        folder
            Made if it is not there.

        Returns
        -------
        list of Path
            The files.
        """
        notes = ("Simulated by graphnav: made data, not a measurement.", *(f"{k}: {v}" for k, v in self.facts.items()))
        files = write_folder(self.recording, folder, [" ".join(note.split()) for note in notes])
        facts = {"simulated": True, "stops": self.stops.tolist(), **self.facts}
        return [*files, write_facts(FilePath(folder) / "simulated.json", facts)]


def read_motion(
    motion: TrueMotion, imu: SimulatedImu, seed: int, exact: bool, truth_rate: float
) -> tuple[Imu, Truth, Trajectory]:
    """An IMU's readings, without its errors if `exact`, the truth at a rate (Hz), and all of it with the biases."""
    gyro, accel = motion.gyro, motion.accel
    b_g, b_a = np.zeros_like(gyro), np.zeros_like(accel)
    if not exact:
        gyro, accel, b_g, b_a = imu.read(gyro, accel, seed)
    rph, every = motion.rph, slice(None, None, max(1, round(imu.rate / truth_rate)))
    whole = Trajectory(
        motion.t, motion.llh, motion.v, rph, name="truth",
        gyro_bias=np.vstack([b_g[:1], b_g]), accel_bias=np.vstack([b_a[:1], b_a]),
    )  # fmt: skip
    sampled = Truth(motion.t[every], motion.llh[every], None, motion.v[every], rph[every])
    return Imu(motion.t[1:], gyro, accel, imu.noise), sampled, whole


def record(
    name: str,
    seed: int,
    path: Path,
    *,
    origin: tuple[float, float, float],
    imu: SimulatedImu,
    mount: Mount,
    shake: Shake,
    gnss: GnssModel | None = None,
    odometer: OdometerModel | None = None,
    barometer: BarometerModel | None = None,
    antennas: DualAntennaModel | None = None,
    exact: bool = False,
    truth_rate: float = 10.0,
    facts: dict[str, Any] | None = None,
) -> Simulated:
    """Drive `path` and read the sensors. `exact` omits the IMU's errors and keeps its stated figures."""
    motion = move_vehicle(path, origin, mount, shake, imu.rate)
    readings, sampled, truth = read_motion(motion, imu, seed, exact, truth_rate)
    known: dict[str, Any] = {"scenario": name, "seed": seed, "imu": imu.name, **(facts or {})}
    known["mounting_deg"] = {"roll": mount.angles[0], "pitch": mount.angles[1], "heading": mount.angles[2]}
    wheels = None
    if odometer is not None:
        wheels, scale = odometer.read(path, mount, seed)
        known["odometer_scale_error"] = scale
    sensors = {}
    for model in (barometer, antennas):
        if model is not None:
            series, put_in = model.read(motion, seed)
            sensors[series.sensor.name] = series
            known[series.sensor.name] = put_in
    recording = Recording(
        name=f"{name} (simulated, seed {seed})",
        platform="vehicle",
        imu=readings,
        gnss=None if gnss is None else gnss.read(motion, seed),
        odometer=wheels,
        truth=sampled,
        sensors=sensors,
    )
    return Simulated(round_recording(recording), truth, path.find_stops(), known, motion)
