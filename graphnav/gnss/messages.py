"""Decoder of navigation messages: ephemerides from the transmitted words.

GPS and QZSS LNAV (IS-GPS-200N, 20.3.3), Galileo I/NAV and F/NAV (OS SIS ICD 2.1, 4.3 and 4.2), BeiDou D1 and, of
geostationary satellites, D2 (BDS-SIS-ICD-B1I 3.0, 5.2 and 5.3) and GLONASS (ICD GLONASS L1/L2 5.1, 4.4). A message is
complete once its parts are of one issue of data.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.timescales import WEEK, gps_to_utc, utc_to_gps
from graphnav.gnss.ephemeris import Ephemerides, Glonass, Kepler
from graphnav.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, QZSS

_PI = 3.1415926535898  # of the interface descriptions
_LNAV_DAY = 86400.0
_E5A, _FNAV = 3, 10_000  # sigId of the signal with F/NAV, and the offset that separates its parts from those of I/NAV
_UBLOX = {0: GPS, 2: GALILEO, 3: BEIDOU, 5: QZSS, 6: GLONASS}
_BDT = 14.0
_MOSCOW = 3 * 3600.0


class Bits:
    """Reader of numbers in a bit string, most significant bit first."""

    def __init__(self, value: int, size: int) -> None:
        self.value, self.size = value, size

    @staticmethod
    def of(words: list[int], width: int, drop: int = 0) -> Bits:
        """Concatenate words of `width` bits without their last `drop` bits."""
        value, keep = 0, width - drop
        for word in words:
            value = value << keep | word >> drop & (1 << keep) - 1
        return Bits(value, keep * len(words))

    def u(self, *parts: tuple[int, int]) -> int:
        """Unsigned integer of concatenated parts (first bit, number of bits)."""
        out = 0
        for at, n in parts:
            out = out << n | self.value >> self.size - at - n & (1 << n) - 1
        return out

    def s(self, *parts: tuple[int, int]) -> int:
        """Signed integer in two's complement."""
        n = sum(x for _, x in parts)
        value = self.u(*parts)
        return value - (1 << n) if value >> n - 1 else value

    def g(self, at: int, n: int) -> int:
        """Signed integer in sign-magnitude form."""
        value = self.u((at + 1, n - 1))
        return -value if self.u((at, 1)) else value


class Decoder:
    """Collects parts of messages and assembles ephemerides."""

    def __init__(self) -> None:
        self._parts: dict[int, dict[int, Bits]] = {}
        self._kepler: list[Kepler] = []
        self._glonass: list[Glonass] = []
        self._channels: dict[int, int] = {}
        self._klobuchar: Array | None = None

    @property
    def ephemerides(self) -> Ephemerides:
        """All ephemerides decoded so far."""
        return Ephemerides.of(self._kepler, self._glonass, self._klobuchar)

    def add(self, payload: bytes, gps: float) -> None:
        """Add one RXM-SFRBX message, received at about `gps`, s since the GPS epoch."""
        if len(payload) < 8 or len(payload) < 8 + 4 * payload[4]:
            return
        system, number = _UBLOX.get(payload[0]), payload[1]
        words = [int(x) for x in np.frombuffer(payload, "<u4", count=payload[4], offset=8)]
        if system is None or not 0 < number < 64:
            return
        satellite = 100 * system + number
        if system in (GPS, QZSS) and len(words) >= 10 and words[0] >> 24 != 0x8B:
            self._parse_lnav(satellite, Bits.of(words[:10], 30, 6), gps)
        elif system == GALILEO and len(words) >= 8:
            own = self._parse_fnav if payload[2] == _E5A else self._parse_inav
            own(satellite, Bits.of(words[:8], 32), gps)
        elif system == BEIDOU and len(words) >= 10:
            (self._parse_d1 if 5 < number < 59 else self._parse_d2)(satellite, Bits.of(words[:10], 30), gps)
        elif system == GLONASS and len(words) >= 4:
            self._channels[satellite] = payload[3] - 7
            self._parse_string(satellite, Bits.of(words[:4], 32), gps)

    def _parse_lnav(self, satellite: int, bits: Bits, gps: float) -> None:
        number = bits.u((43, 3))
        if number == 4 and bits.u((50, 6)) == 56 and satellite // 100 == GPS:
            scale = [2.0**-30, 2.0**-27, 2.0**-24, 2.0**-24, 2.0**11, 2.0**14, 2.0**16, 2.0**16]
            found = [bits.s((56 + 8 * i, 8)) * scale[i] for i in range(8)]
            self._klobuchar = np.array(found).reshape(2, 4)
        if number not in (1, 2, 3):
            return
        parts = self._parts.setdefault(satellite, {})
        parts[number] = bits
        if len(parts) < 3:
            return
        one, two, three = parts[1], parts[2], parts[3]
        issue = two.u((48, 8))
        if issue != three.u((216, 8)) or issue != one.u((168, 8)):
            return
        toc, toes = one.u((176, 16)) * 16.0, two.u((216, 16)) * 16.0
        health = one.u((64, 6))
        parts.clear()
        self._add(
            satellite, _unroll_week(toes, gps), _unroll_week(toc, gps), toes,
            clock=(one.s((216, 22)) * 2.0**-31, one.s((200, 16)) * 2.0**-43, one.s((192, 8)) * 2.0**-55),
            iode=issue, crs=two.s((56, 16)) * 2.0**-5, delta_n=two.s((72, 16)) * 2.0**-43 * _PI,
            m0=two.s((88, 32)) * 2.0**-31 * _PI, cuc=two.s((120, 16)) * 2.0**-29, e=two.u((136, 32)) * 2.0**-33,
            cus=two.s((168, 16)) * 2.0**-29, root_a=two.u((184, 32)) * 2.0**-19,
            cic=three.s((48, 16)) * 2.0**-29, omega0=three.s((64, 32)) * 2.0**-31 * _PI,
            cis=three.s((96, 16)) * 2.0**-29, i0=three.s((112, 32)) * 2.0**-31 * _PI, crc=three.s((144, 16)) * 2.0**-5,
            omega=three.s((160, 32)) * 2.0**-31 * _PI, omega_dot=three.s((192, 24)) * 2.0**-43 * _PI,
            idot=three.s((224, 14)) * 2.0**-43 * _PI,
            healthy=(health & 0x3E if satellite // 100 == QZSS else health) == 0,
            delay=(one.s((160, 8)) * 2.0**-31, np.nan),
        )  # fmt: skip

    def _parse_inav(self, satellite: int, page: Bits, gps: float) -> None:
        # an even and an odd page of 128 bits each, padded; alert pages carry no ephemeris
        if page.u((0, 2)) != 0 or page.u((128, 2)) != 2:
            return
        word = Bits(page.u((2, 112), (130, 16)), 128)
        number = word.u((0, 6))
        if not 1 <= number <= 5:
            return
        parts = self._parts.setdefault(satellite, {})
        parts[number] = word
        if len(parts) < 5:
            return
        one, two, three, four, five = (parts[k] for k in range(1, 6))
        issue = one.u((6, 10))
        if any(x.u((6, 10)) != issue for x in (two, three, four)):
            return
        toes, toc = one.u((16, 14)) * 60.0, four.u((54, 14)) * 60.0
        parts.clear()
        self._add(
            satellite, _unroll_week(toes, gps), _unroll_week(toc, gps), toes,
            clock=(four.s((68, 31)) * 2.0**-34, four.s((99, 21)) * 2.0**-46, four.s((120, 6)) * 2.0**-59),
            iode=issue, crs=three.s((104, 16)) * 2.0**-5, delta_n=three.s((40, 16)) * 2.0**-43 * _PI,
            m0=one.s((30, 32)) * 2.0**-31 * _PI, cuc=three.s((56, 16)) * 2.0**-29, e=one.u((62, 32)) * 2.0**-33,
            cus=three.s((72, 16)) * 2.0**-29, root_a=one.u((94, 32)) * 2.0**-19, cic=four.s((22, 16)) * 2.0**-29,
            omega0=two.s((16, 32)) * 2.0**-31 * _PI, cis=four.s((38, 16)) * 2.0**-29,
            i0=two.s((48, 32)) * 2.0**-31 * _PI, crc=three.s((88, 16)) * 2.0**-5,
            omega=two.s((80, 32)) * 2.0**-31 * _PI, omega_dot=three.s((16, 24)) * 2.0**-43 * _PI,
            idot=two.s((112, 14)) * 2.0**-43 * _PI, healthy=five.u((67, 6)) == 0,
            delay=(five.s((47, 10)) * 2.0**-32, five.s((57, 10)) * 2.0**-32),
        )  # fmt: skip

    def _parse_fnav(self, satellite: int, page: Bits, gps: float) -> None:
        number = page.u((0, 6))
        if not 1 <= number <= 4:
            return
        parts = self._parts.setdefault(satellite + _FNAV, {})
        parts[number] = page
        if len(parts) < 4:
            return
        one, two, three, four = (parts[k] for k in range(1, 5))
        issue = one.u((12, 10))
        if two.u((6, 10)) != issue or three.u((6, 10)) != issue or four.u((6, 10)) != issue:
            return
        toes, toc = three.u((160, 14)) * 60.0, one.u((22, 14)) * 60.0
        parts.clear()
        self._add(
            satellite, _unroll_week(toes, gps), _unroll_week(toc, gps), toes,
            clock=(one.s((36, 31)) * 2.0**-34, one.s((67, 21)) * 2.0**-46, one.s((88, 6)) * 2.0**-59),
            iode=issue, crs=three.s((144, 16)) * 2.0**-5, delta_n=three.s((80, 16)) * 2.0**-43 * _PI,
            m0=two.s((16, 32)) * 2.0**-31 * _PI, cuc=three.s((96, 16)) * 2.0**-29, e=two.u((72, 32)) * 2.0**-33,
            cus=three.s((112, 16)) * 2.0**-29, root_a=two.u((104, 32)) * 2.0**-19, cic=four.s((16, 16)) * 2.0**-29,
            omega0=two.s((136, 32)) * 2.0**-31 * _PI, cis=four.s((32, 16)) * 2.0**-29,
            i0=three.s((16, 32)) * 2.0**-31 * _PI, crc=three.s((128, 16)) * 2.0**-5,
            omega=three.s((48, 32)) * 2.0**-31 * _PI, omega_dot=two.s((48, 24)) * 2.0**-43 * _PI,
            idot=two.s((168, 14)) * 2.0**-43 * _PI, healthy=one.u((153, 2)) == 0,
            delay=(one.s((143, 10)) * 2.0**-32, np.nan), fnav=True,
        )  # fmt: skip

    def _parse_d1(self, satellite: int, bits: Bits, gps: float) -> None:
        number = bits.u((15, 3))
        if number not in (1, 2, 3):
            return
        parts = self._parts.setdefault(satellite, {})
        parts[number] = bits
        if len(parts) < 3:
            return
        one, two, three = parts[1], parts[2], parts[3]
        sent = [x.u((18, 8), (30, 12)) for x in (one, two, three)]
        if sent[1] != sent[0] + 6 or sent[2] != sent[1] + 6:
            return
        toes = (two.u((290, 2)) << 15 | three.u((42, 10), (60, 5))) * 8.0
        toc = one.u((73, 9), (90, 8)) * 8.0
        parts.clear()
        self._add(
            satellite, _unroll_week(toes + _BDT, gps), _unroll_week(toc + _BDT, gps), toes,
            clock=(
                one.s((225, 7), (240, 17)) * 2.0**-33, one.s((257, 5), (270, 17)) * 2.0**-50,
                one.s((214, 11)) * 2.0**-66,
            ),
            iode=one.u((287, 5)), crs=two.s((224, 8), (240, 10)) * 2.0**-6,
            delta_n=two.s((42, 10), (60, 6)) * 2.0**-43 * _PI, m0=two.s((92, 20), (120, 12)) * 2.0**-31 * _PI,
            cuc=two.s((66, 16), (90, 2)) * 2.0**-31, e=two.u((132, 10), (150, 22)) * 2.0**-33,
            cus=two.s((180, 18)) * 2.0**-31, root_a=two.u((250, 12), (270, 20)) * 2.0**-19,
            cic=three.s((105, 7), (120, 11)) * 2.0**-31, omega0=three.s((211, 21), (240, 11)) * 2.0**-31 * _PI,
            cis=three.s((163, 9), (180, 9)) * 2.0**-31, i0=three.s((65, 17), (90, 15)) * 2.0**-31 * _PI,
            crc=two.s((198, 4), (210, 14)) * 2.0**-6, omega=three.s((251, 11), (270, 21)) * 2.0**-31 * _PI,
            omega_dot=three.s((131, 11), (150, 13)) * 2.0**-43 * _PI,
            idot=three.s((189, 13), (210, 1)) * 2.0**-43 * _PI, healthy=one.u((42, 1)) == 0,
            delay=(one.s((98, 10)) * 1e-10, one.s((108, 4), (120, 6)) * 1e-10),
        )  # fmt: skip

    def _parse_d2(self, satellite: int, bits: Bits, gps: float) -> None:
        page = bits.u((42, 4))
        if bits.u((15, 3)) != 1 or not 1 <= page <= 10:
            return
        parts = self._parts.setdefault(satellite, {})
        parts[page] = bits
        sent = {k: x.u((18, 8), (30, 12)) for k, x in parts.items()}
        for k in [k for k in parts if sent[k] - sent[page] != 3 * (k - page)]:
            del parts[k]  # of another issue
        if len(parts) < 10:
            return
        whole = Bits(0, 0)
        for k in range(1, 11):
            whole = Bits(whole.value << 300 | parts[k].value, whole.size + 300)
        parts.clear()

        def cut(page: int, *places: tuple[int, int]) -> list[tuple[int, int]]:
            return [(300 * (page - 1) + first, many) for first, many in places]

        u, s = whole.u, whole.s
        toes, toc = u(*cut(7, (80, 2), (90, 15))) * 8.0, u(*cut(1, (77, 5), (90, 12))) * 8.0
        self._add(
            satellite, _unroll_week(toes + _BDT, gps), _unroll_week(toc + _BDT, gps), toes,
            clock=(
                s(*cut(3, (100, 12), (120, 12))) * 2.0**-33,
                s(*cut(3, (132, 4)), *cut(4, (46, 6), (60, 12))) * 2.0**-50, s(*cut(4, (72, 10), (90, 1))) * 2.0**-66,
            ),
            iode=u(*cut(4, (91, 5))), crs=s(*cut(8, (91, 18))) * 2.0**-6, delta_n=s(*cut(4, (96, 16))) * 2.0**-43 * _PI,
            m0=s(*cut(5, (50, 2), (60, 22), (90, 8))) * 2.0**-31 * _PI,
            cuc=s(*cut(4, (120, 14)), *cut(5, (46, 4))) * 2.0**-31,
            e=u(*cut(5, (124, 10)), *cut(6, (46, 6), (60, 16))) * 2.0**-33,
            cus=s(*cut(5, (98, 14), (120, 4))) * 2.0**-31,
            root_a=u(*cut(6, (76, 6), (90, 22), (120, 4))) * 2.0**-19,
            cic=s(*cut(6, (124, 10)), *cut(7, (46, 6), (60, 2))) * 2.0**-31,
            omega0=s(*cut(9, (51, 1), (60, 22), (90, 9))) * 2.0**-31 * _PI, cis=s(*cut(7, (62, 18))) * 2.0**-31,
            i0=s(*cut(7, (105, 7), (120, 14)), *cut(8, (46, 6), (60, 5))) * 2.0**-31 * _PI,
            crc=s(*cut(8, (65, 17), (90, 1))) * 2.0**-6,
            omega=s(*cut(9, (99, 13), (120, 14)), *cut(10, (46, 5))) * 2.0**-31 * _PI,
            omega_dot=s(*cut(8, (109, 3), (120, 16)), *cut(9, (46, 5))) * 2.0**-43 * _PI,
            idot=s(*cut(10, (51, 1), (60, 13))) * 2.0**-43 * _PI, healthy=u(*cut(1, (46, 1))) == 0,
            delay=(s(*cut(1, (102, 10))) * 1e-10, s(*cut(1, (120, 10))) * 1e-10),
        )  # fmt: skip

    def _parse_string(self, satellite: int, bits: Bits, gps: float) -> None:
        number = bits.u((1, 4))
        if not 1 <= number <= 4:
            return
        parts = self._parts.setdefault(satellite, {})
        if number == 1:
            parts.clear()
        if number != len(parts) + 1:
            return
        parts[number] = bits
        if number < 4:
            return
        states = []
        for k in (1, 2, 3):
            x = parts[k]
            states.append((x.g(50, 27) * 2.0**-11, x.g(21, 24) * 2.0**-20, x.g(45, 5) * 2.0**-30))
        p, v, a = (np.array([one[i] for one in states]) * 1e3 for i in range(3))
        # tb counts quarters of an hour of the day in Moscow time
        day = gps_to_utc(np.array([gps + _MOSCOW]))[0].astype("datetime64[D]")
        utc = day.astype("datetime64[us]") + np.timedelta64(int(parts[2].u((9, 7)) * 900.0 - _MOSCOW), "s")
        toe = float(utc_to_gps(np.array([utc]))[0])
        toe -= _LNAV_DAY * np.round((toe - gps) / _LNAV_DAY)
        self._glonass.append(
            Glonass(
                satellite, toe, p, v, a, -parts[4].g(5, 22) * 2.0**-30, parts[3].g(6, 11) * 2.0**-40,
                self._channels.get(satellite, 0), parts[2].u((5, 3)) >> 2 == 0,
            )
        )  # fmt: skip
        parts.clear()

    def _add(self, satellite: int, toe: float, toc: float, toes: float, **fields: object) -> None:
        one = Kepler(satellite=satellite, toe=toe, toc=toc, toes=toes, accuracy=np.nan, **fields)  # type: ignore[arg-type]
        if one.root_a > 0.0:
            self._kepler.append(one)


def _unroll_week(seconds: float, gps: float) -> float:
    """Seconds of the week as s since the GPS epoch, in the week in which they are nearest to a time."""
    return float(seconds + WEEK * np.round((gps - seconds) / WEEK))
