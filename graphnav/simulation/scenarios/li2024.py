"""Li 2024: two hours through a town with three long stops, the engine idling (Remote Sens. 16, 902)."""

from __future__ import annotations

import numpy as np

from graphnav.core.errors import ConfigError
from graphnav.simulation.aiding import GnssModel, OdometerModel
from graphnav.simulation.inertial import EG370N
from graphnav.simulation.kinematics import Mount
from graphnav.simulation.motion import SETTLE, Manoeuvre, make_path
from graphnav.simulation.passengers import Boarding, Fidget, simulate_movement
from graphnav.simulation.result import Simulated, record
from graphnav.simulation.scenarios.registry import Scenario
from graphnav.simulation.scenarios.town import choose_manoeuvres
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import Engine, Idle, Shake, Springs, simulate_idle_floor, simulate_road_noise

# Table 2, seconds of 12 October 2021 (GPST); a stop's first and last second are in it
_STOP_TIMES = ((2, 4, 7), (2, 20, 13), (2, 37, 31), (2, 59, 32), (3, 21, 42), (3, 41, 54))
START, END = 6920.0, 13845.0  # 01:55:20, 03:50:45
STOPS = tuple(3600.0 * h + 60.0 * m + s for h, m, s in _STOP_TIMES)
# Table 4, mg and deg/s, for half, once and twice the crankshaft's frequency; right is not in the table: figure 3 shows
# one line there, near 12.5 Hz, and more noise. The half order is the 6.248 Hz that the table finds below 10 Hz.
_HALF_ORDER = (0.03, 0.085, 0.03)
TABLE_4 = (
    Idle((_HALF_ORDER, (1.5, 3.085, 5.402), (0.2, 2.124, 3.994)), (0.003, 0.395, 0.003)),
    Idle((_HALF_ORDER, (1.0, 1.622, 2.839), (0.2, 4.283, 2.001)), (0.002, 0.182, 0.005)),
    Idle((_HALF_ORDER, (1.4, 2.821, 4.927), (0.2, 2.829, 4.782)), (0.002, 0.305, 0.005)),
)
MEAN = Idle((_HALF_ORDER, (1.3, 2.509, 4.389), (0.2, 3.078, 3.592)), (0.002, 0.294, 0.004))
# Within a bin of the 12.495 and 24.991 Hz of table 4, and near the middle of a bin of each stop's whole spectrum,
# where the table's amplitudes can be read off again.
IDLE_HZ = 12.49585


def li2024(
    seed: int,
    *,
    engine_hz: float = IDLE_HZ,
    engine: bool = True,
    passengers: bool = True,
    short: bool = False,
    odometer: bool = False,
    exact: bool = False,
    rate: float = 200.0,
) -> Simulated:
    """The drive of table 2, or with `short` a quarter of an hour with stops of 60, 120 and 90 s.

    `engine_hz` moves the idling lines (at once and twice this), `engine` False is an engine switched off at the
    stops and all along, `rate` the IMU's.
    """
    if not 5.0 <= engine_hz <= 50.0:
        raise ConfigError(f"engine_hz = {engine_hz:g}: must be from 5 to 50 Hz", key="simulation.value")
    start, end = (START, START + 900.0) if short else (START, END)
    edges = tuple(START + x for x in (150.0, 210.0, 380.0, 500.0, 680.0, 770.0)) if short else STOPS
    rng = make_random(seed, "way")
    plan, t = [Manoeuvre(15.0, 0.0)], start + 15.0
    # edges of a stop are where the wheels stand to the tenth of a second: the plan accounts for the spline's extent
    for begin, finish in (edges[0:2], edges[2:4], edges[4:6], (end - 5.0, end)):
        still, away = begin - SETTLE, finish + SETTLE if finish < end else end
        plan += [*choose_manoeuvres(still - t, rng), Manoeuvre(away - still, 0.0)]
        t = away
    path = make_path(plan, start=start, heading=75.0, slip_per_accel=0.003)

    mount = Mount(above_axle=(0.0, 1.3, 1.5), angles=(0.3, -0.4, 0.5))  # on the roof
    parts = [simulate_road_noise(path, make_random(seed, "road")), Springs(height=1.2).lean(path)]
    spans = tuple((a - 5.0, b + 5.0, idle) for a, b, idle in zip(edges[::2], edges[1::2], TABLE_4, strict=True))
    if engine:
        motor = Engine(MEAN, engine_hz, (0.5, 1.0, 2.0), spans)
        parts += [
            motor.simulate_lines(path, rate, make_random(seed, "engine")),
            simulate_idle_floor(path, make_random(seed, "idling")),
        ]
    events = _list_events(edges, seed) if passengers else []
    parts.append(simulate_movement(path, events, (0.0, 0.0, 1.2), make_random(seed, "passengers")))
    return record(
        "li2024", seed, path,
        origin=(37.53, 122.06, 20.0), imu=EG370N.change_rate(rate), mount=mount, shake=Shake(tuple(parts)), exact=exact,
        gnss=GnssModel(white=(0.008, 0.008, 0.016), slow=(0.006, 0.006, 0.012), slow_time=300.0),
        odometer=OdometerModel() if odometer else None,
        facts={
            "engine_hz": engine_hz if engine else 0.0,
            "lines_hz": [engine_hz, 2.0 * engine_hz] if engine else [],
            "stop_edges": [list(edges[k : k + 2]) for k in (0, 2, 4)],
            "passenger_events": [event.t for event in events],
            "passenger_events_are": [type(event).__name__.lower() for event in events],
        },
    )  # fmt: skip


def _list_events(edges: tuple[float, ...], seed: int) -> list[Boarding | Fidget]:
    """Passengers: one door at stop 1, most at stop 2, two doors at stop 3; seated passengers move throughout."""
    rng = make_random(seed, "events")

    def place_event(stop: int, share: float) -> float:
        a, b = edges[2 * stop : 2 * stop + 2]
        return float(a + 8.0 + share * (b - a - 24.0) + rng.uniform(-1.0, 1.0))

    events: list[Boarding | Fidget] = [
        Boarding(place_event(0, 0.6), 0.0, 1.0, 1.0),
        Boarding(place_event(1, 0.2), -1.0, 1.0, -1.0), Boarding(place_event(1, 0.45), 0.0, 1.0, -1.0),
        Boarding(place_event(1, 0.7), -1.0, -1.0, 1.0), Boarding(place_event(1, 0.85), 1.0, -1.0, 1.0),
        Boarding(place_event(1, 0.98), 1.0, 1.0, -1.0),
        Boarding(place_event(2, 0.3), 0.0, -1.0, 1.0), Boarding(place_event(2, 0.8), 0.0, -1.0, 1.0),
    ]  # fmt: skip
    for a, b in (edges[0:2], edges[2:4], edges[4:6]):
        for t in a + np.sort(rng.uniform(5.0, b - a - 5.0, rng.poisson((b - a) / 120.0))):
            events.append(Fidget(float(t), float(rng.uniform(0.02, 0.15))))
    return sorted(events, key=lambda event: event.t)


SCENARIOS = [
    Scenario(
        "li2024", "two hours of town, three stops of 16 to 22 min with the engine idling, 200-Hz MEMS, RTK", li2024
    )
]
