"""Meaning of columns: names used by phones, receivers, ROS and data loggers, and the units in them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

# A name is normalised first: lower case, words separated by _, the unit removed. Earlier patterns take precedence.
_TURNING = (
    "angular_(?:velocity|rate)|drehrate|winkelgeschwindigkeit|vitesse_angulaire|velocidad_angular|gir(?:o|oscopio)"
)
_GYRO = rf"(?:.*_)?(?:gyr\w*?|{_TURNING}|ang_vel|omega|rotation_rate|rot_rate|imu_w|w|turn_rate|g)_?"
_ACCEL = (
    r"(?:.*_)?(?:acc\w*?|g_?force|beschleunigung|acel\w*?|linear_acceleration|total_acceleration|specific_force|imu_a|imu_f|force"
    r"|a|f)_?"
)
# increments over a sample
_TURN = r"(?:.*_)?(?:d(?:el(?:ta)?)?_?(?:theta|ang(?:le)?)|angle?_?inc(?:rement)?)_?"
_PUSH = r"(?:.*_)?(?:d(?:el(?:ta)?)?_?v(?:el(?:ocity)?)?|vel(?:ocity)?_?inc(?:rement)?)_?"
_HORIZONTAL = r"sd_?h|(?:.*_)?(?:h_?acc\w*|horizontal_accuracy)|accuracy|eph|epe(?:_m)?"
_VERTICAL = r"sd_?v|(?:.*_)?(?:v_?acc\w*|vertical_accuracy)|altitude_accuracy|epv"
_COVARIANCE = r"(?:.*_)?position_cov(?:ariance)?_?"  # of ROS, 3 x 3 by rows, east, north, up
_OF_SPEED = r"sd_?v|sd_?speed|(?:.*_)?(?:s_?acc|(?:speed|velocity|vel)_?acc\w*)|eps"
# columns of uncertainties, or of satellite geometry, are not the quantity itself
_UNCERTAIN = re.compile(
    r"(?:.*_)?(?:sd|std|stdev|sigma|var|variance|cov\w*|accuracy|[hvpgt]dop|err\w*|uncertainty|ep[hves])(?:_.*)?|.*_acc"
)
_OF_WEEK = r"(?:gps_?)?time_of_week|gps_?time|t(?:ime)?_gps|(?:gps_?)?[st]ow|i_?tow|gps_?sec(?:onds?)?|gnss_time"
_OF_WHEELS = r"(?:.*_)?(?:wheel|odo|odometer|obd\d?|can)_?(?:speed|velocity)"
_WHEEL, _SPEED = r"(?:wheel_?|speed_?|wheel_?speed_?)*", r"(?:_?wheel)?(?:_?speed)?"
_PATTERNS: dict[str, tuple[str, ...]] = {
    "t": (
        r"t", r"seconds_elapsed",
        r"time_elapsed|elapsed_time|elapsed|time_since_start(?:_in)?|rel_?time|time_(?:since_)?boot",
        r"(?:.*_)?header_stamp(?:_secs?)?", r"(?:time(?:stamp)?|t)(?:_(?:unix|utc))?", _OF_WEEK,
        r"(?:unix|epoch|utc|sensor|logging|local)_?time\w*",
        r"sec(?:onds?)?|stamp|(?:.*_)time(?:stamp)?",
        r"date_?time|unix|epoch|utc|(?:uhr)?zeit(?:stempel)?|clock|hora|heure|tiempo|temps|date|datum|millis|micros|ms|us|ns",
    ),
    "week": (r"(?:gps_?)?(?:week|wn)(?:_?(?:no|num|number))?",),
    **{f"g{x}": (rf"{_GYRO}{x}", rf"{_TURN}{x}") for x in "xyz"},
    **{f"a{x}": (rf"{_ACCEL}{x}", rf"{_PUSH}{x}") for x in "xyz"},
    "lat": (r"(?:.*_)?lat(?:itude?)?", r"breite(?:ngrad)?"),
    "lon": (r"(?:.*_)?(?:lon|lng|long|longitude?)", r"l_nge(?:ngrad)?|laenge(?:ngrad)?"),
    "h": (
        r"h|h_?ell|height_?(?:ell\w*)?|ell\w*_height|alt_?ell\w*",
        r"(?:.*_)?(?:alt(?:itude?)?|height|h_?msl|elevation|ele)",
        r"(?:.*_)?(?:alt(?:itude)?|height|h)_?(?:msl|wgs84)?", r"h_he|hoehe|hauteur|altura",
    ),
    "geoid": (
        r"(?:.*_)?geoid(?:al)?(?:_?(?:sep(?:aration)?|height|undulation|h|n))?|undulation|(?:geo_?)?sep(?:aration)?",
    ),
    **{
        f"v{way[0]}": (
            rf"v{way[0]}|v_?{way}|vel_?{way[0]}(?:{way[1:]})?|{way}_vel\w*|velocity_{way[0]}(?:{way[1:]})?|{way[0]}_vel",
            rf"vel_?(?:m_s_)?{way[0]}(?:_m_s)?|{of_axes}",
        )
        for way, of_axes in (
            ("east", r"ned_?v(?:el)?_?y|enu_?v(?:el)?_?x"), ("north", r"ned_?v(?:el)?_?x|enu_?v(?:el)?_?y"),
            ("up", r"enu_?v(?:el)?_?z"), ("down", r"ned_?v(?:el)?_?z"),
        )
    },
    "sd_e": (r"sd_?e|std_?e|sigma_?e|e(?:ast)?_(?:sd|std|sigma)", rf"{_COVARIANCE}[0x]", _HORIZONTAL),
    "sd_n": (r"sd_?n|std_?n|sigma_?n|n(?:orth)?_(?:sd|std|sigma)", rf"{_COVARIANCE}4", _HORIZONTAL),
    "sd_u": (r"sd_?[ud]|std_?[ud]|sigma_?[ud]|(?:up?|d(?:own)?)_(?:sd|std|sigma)", rf"{_COVARIANCE}8", _VERTICAL),
    "sd_ve": (r"(?:sd|std|sigma)_?ve(?:_?east)?|ve_(?:sd|std|sigma)", _OF_SPEED),
    "sd_vn": (r"(?:sd|std|sigma)_?vn(?:_?north)?|vn_(?:sd|std|sigma)", _OF_SPEED),
    "sd_vu": (r"(?:sd|std|sigma)_?v(?:u(?:_?up)?|d(?:_?down)?)|v[ud]_(?:sd|std|sigma)", _OF_SPEED),
    "speed": (
        r"speed", r"(?:wheel|vehicle|odo(?:meter)?|ground|gps|gnss|can|car)_?(?:speed|velocity)",
        r"speed_over_ground|sog|g_?speed",
        r"(?:.*_)?(?:speed|velocity|v_?x|twist_linear_x|linear_x|v)",
        r"geschwindigkeit|tacho(?:meter)?|vitesse|velocidad",
    ),
    "speed_fl": (rf"{_WHEEL}(?:fl|front_left|left_front){_SPEED}",),
    "speed_fr": (rf"{_WHEEL}(?:fr|front_right|right_front){_SPEED}",),
    "speed_rl": (rf"{_WHEEL}(?:rl|rear_left|left_rear){_SPEED}",),
    "speed_rr": (rf"{_WHEEL}(?:rr|rear_right|right_rear){_SPEED}",),
    "course": (
        r"course(?:_over_ground)?|cog", r"(?:.*_)?(?:bearing|track|course|head_mot|motion_heading|heading_of_motion)",
        r"heading|direction|kurs|richtung",  # phyphox has a direction beside its velocity
    ),
    "pressure": (
        r"(?:air_?|baro(?:met(?:er|ric))?_?|atmospheric_?|static_?|abs(?:olute)?_?)?pressure|baro(?:meter)?",
    ),
    "type": (
        r"type", r"q", r"(?:.*_)?(?:fix|gps|gnss|gga|nmea|sol|solution|rtk)_?(?:q|qual\w*|type|status|flag)",
        r"quality|q_?flag",
    ),
    "satellites": (
        r"satellites",
        r"(?:num|n|no|number_of|used)_?(?:sats?|sv|svs|satellites)(?:_used)?", r"(?:sats?|satellites)_?used|sats?",
    ),
    "resid_rms_m": (r"resid(?:ual)?s?_?rms(?:_m)?", r"rms_?(?:of_?)?resid(?:ual)?s?(?:_m)?"),
}  # fmt: skip

# of a reference beside fixes, whose course may be called its heading
_ATTITUDE_PATTERNS = {
    "roll": (r"(?:.*_)?roll(?:_angle)?",), "pitch": (r"(?:.*_)?pitch(?:_angle)?",),
    "heading": (r"(?:.*_)?(?:heading|azimuth|hdg)(?:_angle)?", r"(?:.*_)?yaw(?:_angle)?"),
}  # fmt: skip
ATTITUDE = tuple(_ATTITUDE_PATTERNS)

NAMED_UNITS = {
    "s": ("t", "s"), "sec": ("t", "s"), "seconds": ("t", "s"), "ms": ("t", "ms"), "us": ("t", "us"), "ns": ("t", "ns"),
    "days": ("t", "d"),
    "dps": ("gyro", "deg/s"), "deg_s": ("gyro", "deg/s"), "degps": ("gyro", "deg/s"), "deg_sec": ("gyro", "deg/s"),
    "rad_s": ("gyro", "rad/s"), "rps": ("gyro", "rad/s"), "rads": ("gyro", "rad/s"), "mdps": ("gyro", "mdeg/s"),
    "rad_sec": ("gyro", "rad/s"), "radps": ("gyro", "rad/s"),
    "m_s2": ("accel", "m/s2"), "ms2": ("accel", "m/s2"), "mps2": ("accel", "m/s2"), "m_s_2": ("accel", "m/s2"),
    "m_ss": ("accel", "m/s2"), "m_s_s": ("accel", "m/s2"),
    "g": ("accel", "g"), "mg": ("accel", "mg"),
    "mps": ("speed", "m/s"), "m_s": ("speed", "m/s"), "kmh": ("speed", "km/h"), "km_h": ("speed", "km/h"),
    "kph": ("speed", "km/h"), "kmph": ("speed", "km/h"), "mph": ("speed", "mph"), "kn": ("speed", "knots"),
    "knots": ("speed", "knots"), "kt": ("speed", "knots"), "kts": ("speed", "knots"),
    "deg": ("angle", "deg"), "degrees": ("angle", "deg"), "rad": ("angle", "rad"), "m": ("length", "m"),
    "mm": ("length", "mm"), "cm": ("length", "cm"), "mm_s": ("speed", "mm/s"), "cm_s": ("speed", "cm/s"),
    "pa": ("pressure", "Pa"), "hpa": ("pressure", "hPa"), "mbar": ("pressure", "mbar"), "kpa": ("pressure", "kPa"),
    "inhg": ("pressure", "inHg"),
    "ft": ("length", "ft"), "feet": ("length", "ft"), "foot": ("length", "ft"),
}  # fmt: skip


@dataclass(frozen=True)
class FileColumns:
    """Columns of one file: our name -> the file's, and our name -> the unit stated in its name."""

    names: dict[str, str]
    units: dict[str, str] = field(default_factory=dict)

    @property
    def sensor(self) -> str | None:
        """The sensor of the file as `graphnav.recording.draft.tables` names them, or None; gravity is a phone's own."""
        gyro, accel = ({f"{s}{x}" for x in "xyz"} <= self.names.keys() for s in "ga")
        if "t" not in self.names:
            return None
        if "pull_x" in self.names:
            return "gravity"
        if gyro and accel:
            return "imu"
        if {"lat", "lon"} <= self.names.keys():
            return "gnss"
        wheel = any(name == "speed" or name.startswith("speed_") for name in self.names)
        if gyro or accel:
            return "gyro" if gyro else "accel"
        return "odometer" if wheel else "barometer" if "pressure" in self.names else None


def match_columns(header: Sequence[str], stem: str = "") -> FileColumns:
    """Match a file's columns to ours; `stem`, the file's name, shows what bare x, y, z are of."""
    spelt = [(name, *split_unit(name)) for name in header]
    certain = [some for some in spelt if not _UNCERTAIN.fullmatch(some[1])]
    names: dict[str, str] = {}
    units: dict[str, str] = {}
    for ours, patterns in _PATTERNS.items():
        fit = certain
        if ours.startswith("sd_"):  # "v" may be vertical, and of velocity where another column is the height's
            fit = [some for some in spelt if ours in ("sd_e", "sd_n", "sd_u") or some[0] != names.get("sd_u")]
        found = next(((name, unit) for p in patterns for name, plain, unit in fit if re.fullmatch(p, plain)), None)
        if found is not None:
            names[ours], unit = found
            if unit:
                units[ours] = unit
    bare = {plain: (name, unit) for name, plain, unit in spelt if plain in ("x", "y", "z")}
    kind = next((k for k, word in (("g", "gyr"), ("a", "acc"), ("pull_", "gravity")) if word in stem.lower()), None)
    if kind and len(bare) == 3 and not any(f"{kind}{x}" in names for x in "xyz"):
        for x in "xyz":
            names[f"{kind}{x}"] = bare[x][0]
            if bare[x][1]:
                units[f"{kind}{x}"] = bare[x][1]
    if names.get("speed") in {names.get(f"a{x}") for x in "xyz"}:
        names.pop("speed", None)
    if {"lat", "lon"} <= names.keys() and split_unit(names.get("speed", ""))[0].endswith("x"):
        del names["speed"]  # one of three components, in axes that are not stated
    if "week" in names and not re.fullmatch(_OF_WEEK, split_unit(names.get("t", ""))[0]):
        del names["week"]
    # a single letter does not identify an incomplete triple
    for kind in "ga":
        if not all(f"{kind}{x}" in names for x in "xyz"):
            for x in "xyz":
                names.pop(f"{kind}{x}", None)
    return FileColumns(names, units)


def is_increment(name: str) -> bool:
    """Whether a column of an IMU is called as increments of angle or velocity are."""
    return re.fullmatch(rf"(?:{_TURN}|{_PUSH})[xyz]", split_unit(name)[0]) is not None


def match_attitude(header: Sequence[str]) -> FileColumns:
    """Match the columns of roll, pitch and heading."""
    spelt = [some for name in header if not _UNCERTAIN.fullmatch((some := (name, *split_unit(name)))[1])]
    found = {
        ours: one
        for ours, patterns in _ATTITUDE_PATTERNS.items()
        for one in [next((some for p in patterns for some in spelt if re.fullmatch(p, some[1])), None)]
        if one is not None
    }
    return FileColumns({o: one[0] for o, one in found.items()}, {o: one[2] for o, one in found.items() if one[2]})


def find_wheels(header: Sequence[str]) -> list[str]:
    """The columns of wheels' speeds in a table of fixes, where they are not the receiver's."""
    spelt = [(name, split_unit(name)[0]) for name in header]
    if not all(any(re.fullmatch(p, plain) for _, plain in spelt for p in _PATTERNS[ours]) for ours in ("lat", "lon")):
        return []
    each = [*_PATTERNS["speed_fl"], *_PATTERNS["speed_fr"], *_PATTERNS["speed_rl"], *_PATTERNS["speed_rr"]]
    return [name for name, plain in spelt if any(re.fullmatch(p, plain) for p in (_OF_WHEELS, *each))]


def find_gravity(header: Sequence[str]) -> list[str]:
    """The three columns of a phone's own estimate of gravity, or none."""
    spelt = [(name, split_unit(name)[0]) for name in header]
    found = [next((n for n, plain in spelt if re.fullmatch(rf"(?:.*_)?grav(?:ity)?_?{x}", plain)), "") for x in "xyz"]
    return found if all(found) else []


def find_clocks(header: Sequence[str]) -> list[str]:
    """The columns that may be times, the likeliest first."""
    spelt = [(name, split_unit(name)[0]) for name in header]
    found = [name for p in _PATTERNS["t"] for name, plain in spelt if re.fullmatch(p, plain)]
    return list(dict.fromkeys(found))


def split_unit(name: str) -> tuple[str, str]:
    """The normalised name and the unit in it ('' if none)."""
    # part of the name, not a unit
    name = re.sub(r"[(\[]\s*([xyz]|lat|lon|alt)\s*[)\]]\s*$", r"_\1", name, flags=re.IGNORECASE)
    name = re.sub(r"\[([012])\]\s*$", lambda found: "_" + "xyz"[int(found[1])], name)  # of an array of three
    name = re.sub(r"\[([3-8])\]\s*$", r"_\1", name)  # of a matrix
    bracket = re.search(r"[(\[]([^)\]]*)[)\]]\s*$", name)
    base = name[: bracket.start()] if bracket else name
    base = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", base)
    plain = re.sub(r"[^a-z0-9]+", "_", base.lower()).strip("_")
    if bracket:
        unit = bracket[1].lower().replace("²", "2").replace("°", "deg").replace("µ", "u").replace("^", "")
        unit = re.sub(r"[^a-z0-9]+", "_", unit).strip("_")
        again, same = split_unit(base)  # as in "lat_deg [deg]"
        return again if same and NAMED_UNITS.get(same) == NAMED_UNITS.get(unit) else plain, unit
    words = plain.split("_")
    for count in (3, 2, 1):
        unit = "_".join(words[-count:])
        # "a_g" may be anything; "g" and "s" alone are names
        if len(words) > count and unit in NAMED_UNITS:
            return "_".join(words[:-count]), unit
    return plain, ""


def find_stated_unit(columns: FileColumns, ours: str, kind: str) -> str | None:
    """The unit of recording.toml that a column's name states, if it is one of that kind."""
    found = NAMED_UNITS.get(columns.units.get(ours, ""))
    return found[1] if found and found[0] == kind else None
