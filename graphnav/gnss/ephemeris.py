"""Satellite positions, velocities and clocks from broadcast ephemerides, for all rows at once.

GPS, Galileo, BeiDou and QZSS broadcast Kepler elements with corrections (IS-GPS-200N, 20.3.3.4.3 and table 20-IV;
Galileo OS SIS ICD 2.1, section 5.1; BDS-SIS-ICD-B1I 3.0, section 5.2.4.12, whose geostationary satellites are in a
frame of their own), GLONASS a state that is integrated (ICD GLONASS L1/L2 5.1, A.3.1.2). Velocities are derivatives of
the same formulas. Clocks include the relativistic effect of the orbit's eccentricity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from graphnav.core.rotation import Array
from graphnav.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, QZSS, C, Ids, find_system

_MU = {GPS: 3.9860050e14, GALILEO: 3.986004418e14, BEIDOU: 3.986004418e14, QZSS: 3.986005e14}
_OMEGA = {GPS: 7.2921151467e-5, GALILEO: 7.2921151467e-5, BEIDOU: 7.292115e-5, QZSS: 7.2921151467e-5}
OMEGA_WGS84 = 7.2921151467e-5  # rad/s, of WGS-84
_OLDEST_EPHEMERIS = {
    GPS: 7201.0,
    GALILEO: 14400.0,
    BEIDOU: 21601.0,
    QZSS: 7201.0,
    GLONASS: 1800.0,
}  # s from toe; RTKLIB's limits
_TILT = np.radians(5.0)  # inclination of the frame of geostationary BeiDou satellites
_MU_R, _J2, _RATE_R, _RADIUS_R = 3.9860044e14, 1.0826257e-3, 7.292115e-5, 6378136.0  # PZ-90
_INTEGRATION_STEP = 60.0  # s at most, of the integration of GLONASS orbits


@dataclass(frozen=True)
class Kepler:
    """One ephemeris of Kepler elements, SI and radians; times in s since the GPS epoch."""

    satellite: int
    toe: float
    toc: float
    clock: tuple[float, float, float]  # s, s/s, s/s^2
    iode: float
    crs: float
    delta_n: float
    m0: float
    cuc: float
    e: float
    cus: float
    root_a: float
    toes: float  # s of the week of the system's own time
    cic: float
    omega0: float
    cis: float
    i0: float
    crc: float
    omega: float
    omega_dot: float
    idot: float
    accuracy: float  # m
    healthy: bool
    delay: tuple[float, float]  # s: TGD; BGD E5a and E5b; TGD1 and TGD2
    fnav: bool = False  # of Galileo: its clock is that of E1 and E5a


@dataclass(frozen=True)
class Glonass:
    """One ephemeris of GLONASS: a state in the Earth-fixed frame, and the acceleration by Sun and Moon."""

    satellite: int
    toe: float  # s since the GPS epoch
    p: Array  # (3,) m
    v: Array  # (3,) m/s
    a: Array  # (3,) m/s^2
    clock: float  # s, -tau_n
    drift: float  # gamma_n
    channel: int
    healthy: bool


@dataclass(frozen=True)
class Placed:
    """Satellites at the times of transmission, in the Earth-fixed frame of those times; NaN where not known."""

    p: Array  # (N, 3) m
    v: Array  # (N, 3) m/s
    clock: Array  # (N,) s, ahead of GPS time
    drift: Array  # (N,) s/s

    @staticmethod
    def unknown(n: int) -> Placed:
        """All rows unknown."""
        one = np.full(n, np.nan)
        return Placed(np.full((n, 3), np.nan), np.full((n, 3), np.nan), one, one.copy())


@dataclass(frozen=True)
class Ephemerides:
    """Broadcast ephemerides of all satellites, by satellite and toe."""

    kepler: dict[str, Array]  # fields of `Kepler`, (M,) or (M, k)
    glonass: dict[str, Array]
    klobuchar: Array | None = None  # (2, 4) alpha and beta
    remarks: tuple[str, ...] = ()

    @staticmethod
    def of(
        kepler: list[Kepler], glonass: list[Glonass], klobuchar: Array | None = None, remarks: tuple[str, ...] = ()
    ) -> Ephemerides:
        """From single messages, in any order; repeated ones are kept once."""
        same = {(k.satellite, k.toe, k.toc, k.fnav): k for k in kepler}
        alike = {(g.satellite, g.toe): g for g in glonass}
        return Ephemerides(
            _take_columns(Kepler, sorted(same.values(), key=lambda k: k.toe)),
            _take_columns(Glonass, sorted(alike.values(), key=lambda g: g.toe)),
            klobuchar,
            remarks,
        )

    def join(self, other: Ephemerides) -> Ephemerides:
        """These and others; where satellite and toe are the same, these."""
        kepler = [
            Kepler(**{n: v[k] for n, v in one.kepler.items()})
            for one in (other, self)
            for k in range(len(one.kepler["toe"]))
        ]
        glonass = [
            Glonass(**{n: v[k] for n, v in one.glonass.items()})
            for one in (other, self)
            for k in range(len(one.glonass["toe"]))
        ]
        klobuchar = other.klobuchar if self.klobuchar is None else self.klobuchar
        return Ephemerides.of(kepler, glonass, klobuchar, (*self.remarks, *other.remarks))

    @property
    def channels(self) -> dict[int, int]:
        """Frequency channels of the GLONASS satellites."""
        one = self.glonass
        return {int(s): int(c) for s, c in zip(one["satellite"], one["channel"], strict=True)}

    @property
    def satellites(self) -> set[int]:
        """Satellites that have an ephemeris."""
        return {int(s) for s in (*self.kepler["satellite"], *self.glonass["satellite"])}

    @property
    def unhealthy(self) -> set[int]:
        """Satellites marked unhealthy in all of their ephemerides."""
        some = [(one["satellite"], one["healthy"]) for one in (self.kepler, self.glonass)]
        bad = {int(x) for s, h in some for x in s[~h.astype(bool)]}
        return bad - {int(x) for s, h in some for x in s[h.astype(bool)]}

    def choose(self, satellite: Ids, t: Array, zero: float) -> NDArray[np.intp]:
        """(N,) the ephemeris of each row: nearest in toe, for Galileo the latest I/NAV before; -1 for none.

        Indices beyond the Kepler ephemerides are of GLONASS.
        """
        out = np.full(len(t), -1, dtype=np.intp)
        M = len(self.kepler["toe"])
        for one in np.unique(satellite):
            own, source = np.flatnonzero(satellite == one), self.glonass if one // 100 == GLONASS else self.kepler
            which = np.flatnonzero((source["satellite"] == one) & source["healthy"].astype(bool))
            if one // 100 == GALILEO and (source["fnav"][which] == 0).any():
                which = which[source["fnav"][which] == 0]
            if not len(which):
                continue
            age = t[own][:, None] - (source["toe"][which] - zero)
            far = np.abs(np.round(age))  # of two equally near, to the second, the later, as in RTKLIB
            if one // 100 == GALILEO:
                far = np.where(age < 0.0, far + _OLDEST_EPHEMERIS[GALILEO], far)
            best = far.shape[1] - 1 - np.argmin(far[:, ::-1], axis=1)
            near = (
                np.abs(age[np.arange(len(own)), best]) <= _OLDEST_EPHEMERIS[one // 100]
                if one // 100 in _OLDEST_EPHEMERIS
                else False
            )
            out[own] = np.where(near, which[best] + (M if one // 100 == GLONASS else 0), -1)
        return out

    def place(self, satellite: Ids, t: Array, zero: float) -> Placed:
        """Satellites at times of transmission by their own clocks, t (N,) s since `zero` (s since the GPS epoch)."""
        out, which = Placed.unknown(len(t)), self.choose(satellite, t, zero)
        M = len(self.kepler["toe"])
        for own, number, solve in (
            (np.flatnonzero((which >= 0) & (which < M)), which, self._compute_orbit),
            (np.flatnonzero(which >= M), which - M, self._integrate),
        ):
            if len(own):
                for name, value in solve(number[own], t[own], zero).items():
                    getattr(out, name)[own] = value
        return out

    def compute_delay(self, satellite: Ids, signal: Ids, frequency: Array, t: Array, zero: float) -> Array:
        """(N,) s, group delay of a signal relative to the broadcast clock's; to be subtracted from the clock.

        TGD and BGD of the ICDs named above, scaled by frequency; 0 for signals that they do not cover.
        """
        which = self.choose(satellite, t, zero)
        known = (which >= 0) & (which < len(self.kepler["toe"]))
        delay = np.zeros((len(t), 2))
        delay[known] = np.nan_to_num(self.kepler["delay"][which[known]])
        fnav = np.zeros(len(t), dtype=bool)
        fnav[known] = self.kepler["fnav"][which[known]] > 0
        system, band = find_system(satellite), signal // 100
        ratio = np.nan_to_num((1575.42e6 / frequency) ** 2)
        out = np.zeros(len(t))
        like_gps = (system == GPS) | (system == QZSS)
        out[like_gps] = (ratio * delay[:, 0])[like_gps]
        galileo = np.where(fnav, delay[:, 0], delay[:, 1]) * ratio
        out[system == GALILEO] = galileo[system == GALILEO]
        for number, k in ((2, 0), (7, 1)):
            own = (system == BEIDOU) & (band == number)
            out[own] = delay[own, k]
        return out

    def _compute_orbit(self, k: NDArray[np.intp], t: Array, zero: float) -> dict[str, Array]:
        """Orbit at times of transmission by the satellite's clock, which is off by less than a millisecond."""
        eph = {name: value[k] for name, value in self.kepler.items()}
        system = find_system(eph["satellite"])
        mu, rate = (np.select([system == s for s in table], list(table.values())) for table in (_MU, _OMEGA))
        since = t - (eph["toc"] - zero)
        for _ in range(2):
            since = t - (eph["toc"] - zero) - _evaluate_clock(eph["clock"], since)
        tk = since + (eph["toc"] - eph["toe"])
        A, e = eph["root_a"] ** 2, eph["e"]
        n = np.sqrt(mu / A**3) + eph["delta_n"]
        M = eph["m0"] + n * tk
        E = M + e * np.sin(M)
        for _ in range(8):
            E = E - (E - e * np.sin(E) - M) / (1.0 - e * np.cos(E))
        sin_e, cos_e = np.sin(E), np.cos(E)
        E_dot = n / (1.0 - e * cos_e)
        root = np.sqrt(1.0 - e * e)
        phi = np.arctan2(root * sin_e, cos_e - e) + eph["omega"]
        phi_dot = root * E_dot / (1.0 - e * cos_e)
        s2, c2 = np.sin(2.0 * phi), np.cos(2.0 * phi)
        u = phi + eph["cus"] * s2 + eph["cuc"] * c2
        r = A * (1.0 - e * cos_e) + eph["crs"] * s2 + eph["crc"] * c2
        i = eph["i0"] + eph["idot"] * tk + eph["cis"] * s2 + eph["cic"] * c2
        u_dot = phi_dot * (1.0 + 2.0 * (eph["cus"] * c2 - eph["cuc"] * s2))
        r_dot = A * e * sin_e * E_dot + 2.0 * phi_dot * (eph["crs"] * c2 - eph["crc"] * s2)
        i_dot = eph["idot"] + 2.0 * phi_dot * (eph["cis"] * c2 - eph["cic"] * s2)
        number = eph["satellite"] % 100
        fixed = (system == BEIDOU) & ((number <= 5) | (number >= 59))
        turning = eph["omega_dot"] - np.where(fixed, 0.0, rate)
        node = eph["omega0"] + turning * tk - rate * eph["toes"]
        x, y = r * np.cos(u), r * np.sin(u)
        x_dot, y_dot = r_dot * np.cos(u) - y * u_dot, r_dot * np.sin(u) + x * u_dot
        so, co, si, ci = np.sin(node), np.cos(node), np.sin(i), np.cos(i)
        p = np.stack([x * co - y * ci * so, x * so + y * ci * co, y * si], -1)
        v = np.stack(
            [
                x_dot * co - y_dot * ci * so + y * si * so * i_dot - p[:, 1] * turning,
                x_dot * so + y_dot * ci * co - y * si * co * i_dot + p[:, 0] * turning,
                y_dot * si + y * ci * i_dot,
            ],
            -1,
        )
        if fixed.any():
            angle = rate * tk
            turned, moving = _turn_about_z(_turn_about_x(p), angle), _turn_about_z(_turn_about_x(v), angle)
            moving = moving + rate[:, None] * np.stack([turned[:, 1], -turned[:, 0], np.zeros(len(t))], -1)
            p, v = np.where(fixed[:, None], turned, p), np.where(fixed[:, None], moving, v)
        relative = -2.0 * np.sqrt(mu * A) * e / C**2
        return {
            "p": p,
            "v": v,
            "clock": _evaluate_clock(eph["clock"], since) + relative * sin_e,
            "drift": eph["clock"][:, 1] + 2.0 * eph["clock"][:, 2] * since + relative * cos_e * E_dot,
        }

    def _integrate(self, k: NDArray[np.intp], t: Array, zero: float) -> dict[str, Array]:
        eph = {name: value[k] for name, value in self.glonass.items()}
        since = t - (eph["toe"] - zero)
        for _ in range(2):
            since = t - (eph["toe"] - zero) - (eph["clock"] + eph["drift"] * since)
        x = np.concatenate([eph["p"], eph["v"]], axis=1)
        steps = int(np.ceil(np.max(np.abs(since)) / _INTEGRATION_STEP)) or 1
        for j in range(steps):
            h = np.clip(since - np.sign(since) * j * _INTEGRATION_STEP, -_INTEGRATION_STEP, _INTEGRATION_STEP)
            h = np.where(np.abs(since) > j * _INTEGRATION_STEP, h, 0.0)[:, None]
            x = _step_runge_kutta(lambda state: _derive_glonass(state, eph["a"]), x, h)
        return {
            "p": x[:, :3],
            "v": x[:, 3:],
            "clock": eph["clock"] + eph["drift"] * since,
            "drift": eph["drift"],
        }


def _take_columns(kind: type, some: list) -> dict[str, Array]:  # type: ignore[type-arg]
    whole = {f.name: np.array([getattr(one, f.name) for one in some]) for f in fields(kind)}
    whole["satellite"] = whole["satellite"].astype(np.int16)
    if not some:
        shapes = {"clock": (0, 3), "delay": (0, 2), "p": (0, 3), "v": (0, 3), "a": (0, 3)}
        whole = {name: value.reshape(shapes.get(name, (0,))) for name, value in whole.items()}
    return whole


def _evaluate_clock(clock: Array, t: Array) -> Array:
    return np.asarray(clock[:, 0] + t * (clock[:, 1] + t * clock[:, 2]))


def _turn_about_z(x: Array, angle: Array) -> Array:
    """Coordinates (N, 3) in axes turned by angles (N,) about z."""
    s, c = np.sin(angle), np.cos(angle)
    return np.stack([c * x[:, 0] + s * x[:, 1], -s * x[:, 0] + c * x[:, 1], x[:, 2]], -1)


def _turn_about_x(x: Array) -> Array:
    """Coordinates (N, 3) in axes turned by -5 deg about x."""
    s, c = np.sin(-_TILT), np.cos(-_TILT)
    return np.stack([x[:, 0], c * x[:, 1] + s * x[:, 2], -s * x[:, 1] + c * x[:, 2]], -1)


def rotate_earth(p: Array, seconds: Array) -> Array:
    """Earth-fixed coordinates (N, 3) in the Earth-fixed frame of a time (N,) s later."""
    return _turn_about_z(p, OMEGA_WGS84 * seconds)


def _derive_glonass(x: Array, a: Array) -> Array:
    p, v = x[:, :3], x[:, 3:]
    r2 = np.sum(p * p, axis=1)
    r3 = r2 * np.sqrt(r2)
    c = 1.5 * _J2 * _MU_R * _RADIUS_R**2 / r2 / r3
    z = 5.0 * p[:, 2] ** 2 / r2
    common = -_MU_R / r3 - c * (1.0 - z)
    out = np.empty_like(x)
    out[:, :3] = v
    out[:, 3] = (common + _RATE_R**2) * p[:, 0] + 2.0 * _RATE_R * v[:, 1] + a[:, 0]
    out[:, 4] = (common + _RATE_R**2) * p[:, 1] - 2.0 * _RATE_R * v[:, 0] + a[:, 1]
    out[:, 5] = (common - 2.0 * c) * p[:, 2] + a[:, 2]
    return out


def _step_runge_kutta(rate: Callable[[Array], Array], x: Array, h: Array) -> Array:
    """One step of fourth order, h (N, 1) s."""
    k1 = rate(x)
    k2 = rate(x + 0.5 * h * k1)
    k3 = rate(x + 0.5 * h * k2)
    k4 = rate(x + h * k3)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
