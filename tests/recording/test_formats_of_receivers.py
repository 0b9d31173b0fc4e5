"""NovAtel's ASCII logs and Android's GnssLogger: what is read is what was driven; damage is counted or refused."""

from __future__ import annotations

import json

import logs
import numpy as np
import pytest
from helpers import assert_told, refused

from graphnav.app import cli, convert
from graphnav.core.errors import RecordingError
from graphnav.recording.formats import load, read
from graphnav.recording.formats.novatel import _parse_line

RECORDING, TRUTH = logs.simulated(20.0)

# printed in NovAtel's manual (docs.novatel.com/OEM7) and on its page of examples
PRINTED = {
    "BESTPOS": (
        "#BESTPOSA,COM1,0,47.0,FINESTEERING,1803,27504.000,00000000,6145,9603;SOL_COMPUTED,L1_FLOAT,32.81519645735,"
        '35.00791046612,19.9359,20.3000,WGS84,0.0363,0.0538,0.0956,"0",3.000,0.000,18,9,9,0,0,00,00,01*ecbd3409'
    ),
    "BESTGNSSVEL": (
        "#BESTGNSSVELA,USB1,0,64.0,FINESTEERING,2209,488172.000,02000020,00b0,16809;SOL_COMPUTED,PPP,0.250,12.000,"
        "0.0025,23.890175,0.0021,0.0*f40aab04"
    ),
    "RAWIMU": (
        "%RAWIMUSA,2209,491612.254;2209,491612.253588,ea5afe00,329303960,-2512321,4410363,309705,607017,-1009773"
        "*1fb76c28"
    ),
    "RAWIMUX": (
        "%RAWIMUSXA,2209,491674.014;04,41,2209,491674.013699,ea59fe00,329308016,-2706935,4508389,196192,417138,"
        "-1000837*038422a7"
    ),
    "INSPVA": (
        "%INSPVASA,2209,490712.000;2209,490712.000000000,51.15043713712,-114.03067872932,1080.3580,0.0014,-0.0007,"
        "0.0015,-0.293782412,0.302470613,157.989827209,INS_SOLUTION_GOOD*a87ab88b"
    ),
    "INSPVAX": (
        "#INSPVAXA,USB1,0,65.5,FINESTEERING,2209,490782.000,02000020,46eb,16809;INS_SOLUTION_GOOD,INS_PPP,"
        "51.15043710672,-114.03067871892,1097.3598,-17.0001,-0.0016,0.0002,0.0029,-0.308665944,0.297893298,"
        "157.960833016,0.1816,0.1816,0.1808,0.0018,0.0018,0.0016,0.0292,0.0292,0.0582,13000045,0*a74644a2"
    ),
}


@pytest.mark.parametrize("name", PRINTED)
def test_lines_printed_by_novatel_have_their_crc_and_name(name):
    line = PRINTED[name].encode()[1:]
    assert _parse_line(line)[0] == name
    damaged = line.replace(b";", b"; ", 1)
    with pytest.raises(ValueError, match="CRC"):
        _parse_line(damaged)


def test_the_printed_positions_and_attitudes_are_read_alike(tmp_path):
    """INSPVAX gives the height above the sea and the undulation, INSPVA that above the ellipsoid, 70 s later."""
    found = {}
    for name in ("INSPVA", "INSPVAX"):
        path = tmp_path / f"{name}.txt"
        path.write_text(PRINTED[name] + "\n")
        found[name] = load(path).truth
    one, other = found["INSPVA"], found["INSPVAX"]
    assert one.llh[0, :2] == pytest.approx(np.radians([51.15043713712, -114.03067872932]), abs=1e-12)
    assert other.llh[0, 2] == pytest.approx(one.llh[0, 2], abs=0.01)
    assert other.v[0] == pytest.approx([0.0002, -0.0016, 0.0029])
    assert np.degrees(other.rph[0]) == pytest.approx([-0.308665944, 0.297893298, 157.960833016])
    assert (one.t[0], other.t[0]) == (490712.0, 490782.0)


def test_printed_counts_at_rest_are_gravity(tmp_path):
    """Of an Epson G320, whose counts are rates, so that they do not depend on how often they were logged."""
    body = PRINTED["RAWIMUX"].rpartition("*")[0].partition(";")[2]
    rows = [logs.novatel("RAWIMUSXA", body.replace("491674.013699", f"{logs.TOW + k / 125:.6f}"), 0) for k in range(9)]
    path = tmp_path / "rest.txt"
    path.write_text("".join(rows))
    imu = read(path).imu
    assert np.linalg.norm(imu.accel, axis=1) == pytest.approx(9.8566, abs=1e-4)
    assert imu.accel[0] == pytest.approx(np.array([4508389, 2706935, 329308016]) * 0.2 / 65536 * 9.80665e-3)
    assert np.degrees(imu.gyro[0]) == pytest.approx(np.array([-1000837, -417138, 196192]) * 0.008 / 65536)


@pytest.mark.parametrize(
    ("imu", "kind", "counts"),
    [
        ("RAWIMUSXA", 26, (1e-9, 2e-8)),
        ("RAWIMUXA", 58, (2.0**-33, 2.0**-29)),
        ("RAWIMUSA", 31, (720 * 2.0**-31 * np.pi / 180, 200 * 2.0**-31)),  # by gravity
    ],
)
def test_a_drive_of_novatel_is_read_as_it_was_driven(tmp_path, imu, kind, counts):
    found = read(logs.write_novatel(tmp_path / "a.log", RECORDING, TRUTH, imu, kind, 0.25, counts))
    assert found.gps_zero == logs.WEEK * 604800.0
    assert found.imu.t == pytest.approx(logs.TOW + RECORDING.imu.t, abs=2e-6)
    rate = 1.0 / np.median(np.diff(RECORDING.imu.t))
    assert found.imu.gyro == pytest.approx(RECORDING.imu.gyro, rel=1e-5, abs=counts[0] * rate)
    assert found.imu.accel == pytest.approx(RECORDING.imu.accel, rel=1e-5, abs=counts[1] * rate)
    assert found.gnss.t == pytest.approx(logs.TOW + RECORDING.gnss.t, abs=2e-3)
    assert found.gnss.llh[:, :2] == pytest.approx(RECORDING.gnss.llh[:, :2], abs=1e-12)
    assert found.gnss.llh[:, 2] == pytest.approx(RECORDING.gnss.llh[:, 2], abs=1e-4)
    assert found.gnss.sd == pytest.approx(RECORDING.gnss.sd)
    assert found.gnss.v == pytest.approx(RECORDING.gnss.v, abs=1e-5)
    assert found.gnss.velocity_offset == -0.25
    assert found.gnss.types == {"fixed": len(RECORDING.gnss.t)}
    at = np.searchsorted(TRUTH.t, found.truth.t - logs.TOW - 1e-6)
    assert found.truth.rph == pytest.approx(TRUTH.rph[at], abs=1e-9)
    assert found.truth.v == pytest.approx(TRUTH.v[at], abs=1e-6)


def test_the_times_of_velocities_survive_conversion(tmp_path):
    log = logs.write_novatel(tmp_path / "a.log", RECORDING, TRUTH, latency=0.25)
    convert.convert_log(str(log), tmp_path / "out", None)
    assert read(tmp_path / "out").gnss.velocity_offset == -0.25


def test_damage_and_rows_without_a_solution_are_counted(tmp_path):
    path = logs.write_novatel(tmp_path / "a.log", RECORDING, TRUTH)
    lines = path.read_text().splitlines(keepends=True)
    imu = [k for k, line in enumerate(lines) if "RAWIMU" in line]
    fixes = [k for k, line in enumerate(lines) if "BESTPOS" in line]
    lines[imu[5]] = lines[imu[5]].replace(",26,", ",27,")  # the CRC no longer fits
    lines[fixes[2]] = logs.novatel("BESTPOSA", 'INSUFFICIENT_OBS,NONE,0,0,0,0,WGS84,0,0,0,"",0,0,3,0,0,0,0,0,0,0', 9.0)
    lines[fixes[3]] = logs.novatel(
        "BESTPOSA", 'SOL_COMPUTED,PROPAGATED,0,0,0,0,WGS84,1,1,1,"",0,0,3,0,0,0,0,0,0,0', 9.0
    )
    lines.insert(0, "[COM1]<OK\r\n$GPGGA,,,\r\n" + lines[fixes[0]].replace("FINESTEERING,2200", "UNKNOWN,0"))
    path.write_bytes("".join(lines).encode()[:-20] + b"\xff\xfe")
    log = load(path)
    assert len(log.imu.t) == len(imu) - 1
    assert len(log.gnss.t) == len(fixes) - 2
    assert_told(log.remarks, "log.broken_lines", "a.log, line 3", "skipped 3")
    assert_told(log.remarks, "gnss.unsolved", "1 INSUFFICIENT_OBS", "1 PROPAGATED")


def test_counts_of_an_unknown_size_are_refused(tmp_path):
    path = logs.write_novatel(tmp_path / "a.log", RECORDING, TRUTH, kind=99)
    with refused("imu.scale", RecordingError, "a.log", "99"):
        load(path)
    with refused("imu.scale", RecordingError, "a.log", "58"):
        load(logs.write_novatel(path, RECORDING, TRUTH, kind=58))
    with refused("imu.scale", RecordingError, "a.log", "RAWIMUX"):  # two makers' have these of the force
        load(logs.write_novatel(path, RECORDING, TRUTH, "RAWIMUSA", counts=(1e-9, 0.05 * 2.0**-15)))
    corrected = logs.novatel("CORRIMUDATAA", "2200,345600.0,0,0,0,0,0,0", 0.0)
    path.write_text(corrected)
    with refused("log.no_messages", RecordingError, "a.log", "CORRIMUDATA", "RAWIMUSX"):
        load(path)


# ---- GnssLogger


def test_a_phones_log_is_read_as_it_was_driven(tmp_path):
    log = load(logs.write_gnsslogger(tmp_path / "gnss_log.txt", RECORDING))
    assert log.gps_zero == logs.WEEK * 604800.0
    inside = slice(1, -1)  # of the forces' times
    assert log.imu.t == pytest.approx(logs.TOW + RECORDING.imu.t[inside], abs=2e-3)
    assert np.diff(log.imu.t) == pytest.approx(np.diff(RECORDING.imu.t[inside]), abs=1e-6)
    assert log.imu.gyro == pytest.approx(RECORDING.imu.gyro[inside], abs=1e-9)
    assert log.imu.accel == pytest.approx(RECORDING.imu.accel[inside], abs=0.02)
    assert log.gnss.t == pytest.approx(logs.TOW + RECORDING.gnss.t, abs=2e-3)
    assert log.gnss.llh == pytest.approx(RECORDING.gnss.llh, abs=1e-6)
    assert log.gnss.sd == pytest.approx(RECORDING.gnss.sd, rel=1e-3)
    assert log.gnss.v[:, :2] == pytest.approx(RECORDING.gnss.v[:, :2], abs=1e-5)
    assert_told(log.remarks, "gnss.providers", f"{len(RECORDING.gnss.t)} nlp")
    assert_told(log.remarks, "log.unused", f"{len(RECORDING.gnss.t)} Raw")


def test_an_old_phones_log_without_times_since_boot_in_its_fixes(tmp_path):
    """As GPSTest 3 writes it (LOGGING.md): other names, no bearing."""
    path = tmp_path / "gnss_log.txt"
    path.write_text(
        "#   Fix,Provider,Latitude,Longitude,Altitude,Speed,Accuracy,(UTC)TimeInMs\n#\n"
        "NMEA,$GNVTG,,T,,M,0.0,N,0.0,K,A*3D,1568222348218\n"
        "Fix,gps,28.071355,-82.426751,14.320496,0.000000,38.592003,1568222340000\n"
    )
    gnss = load(path).gnss
    assert np.degrees(gnss.llh[0, :2]) == pytest.approx([28.071355, -82.426751])
    assert gnss.sd[0] == pytest.approx(38.592003 / 1.5096 * np.array([1, 1, 2]), rel=1e-4)
    assert gnss.t[0] == (1568222340 - 315964800 + 18) % 604800


def test_a_phones_damaged_log_is_counted(tmp_path):
    path = logs.write_gnsslogger(tmp_path / "gnss_log.txt", RECORDING)
    lines = path.read_bytes().split(b"\n")
    gyro = [k for k, line in enumerate(lines) if line.startswith(b"UncalGyro")]
    lines[gyro[7]] = lines[gyro[7]][:30]
    lines[gyro[9]] = lines[gyro[9]].replace(b"0.0", b"\xff", 1)
    path.write_bytes(b"\n".join(lines)[:-9])
    log = load(path)
    assert_told(log.remarks, "log.broken_lines", f"line {gyro[7] + 1}", "skipped 3")
    assert len(log.imu.t) in (len(gyro) - 5, len(gyro) - 4)
    path.write_text("# Fix,Provider,Latitude\nUncalGyro,1,2,0,0,0,0,0,0\nFix,GPS,x,y\n")
    with refused("log.no_messages", RecordingError, "gnss_log.txt"):
        load(path)


@pytest.mark.parametrize("form", ["novatel", "gnsslogger"])
def test_init_drafts_a_description_of_it_that_can_be_read(tmp_path, form):
    recording, truth = logs.simulated(60.0)
    path = tmp_path / "drive.txt"
    if form == "novatel":
        logs.write_novatel(path, recording, truth)
    else:
        logs.write_gnsslogger(path, recording)
    assert cli.run(["init", str(path), "-o", str(tmp_path / "recording.toml")]) == 0
    found = read(tmp_path / "recording.toml")
    assert found.imu.R_bs == pytest.approx(np.eye(3), abs=0.1)
    assert len(found.gnss.t) == len(recording.gnss.t)
    out = tmp_path / "out"
    assert cli.run(["smooth", str(tmp_path / "recording.toml"), "-o", str(out), "--solver", "rts", "--quiet"]) == 0
    assert json.loads((out / "summary.json").read_text())["messages"]
