"""The u-blox log of the clone: re-encoded from the RINEX beside it, and what a reader has of it is what that has."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from graphnav.gnss.load import read_rover
from graphnav.gnss.rinex_nav import read_navigation
from graphnav.gnss.signals import name_satellite, name_signal

ROOT = Path(__file__).resolve().parents[2]
KAMAKURA = ROOT / "data" / "kamakura_rtk"


@pytest.fixture(scope="module")
def encoder():
    spec = importlib.util.spec_from_file_location("encode_ubx", ROOT / "scripts" / "encode_ubx.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def rinex():
    return read_rover((KAMAKURA / "rover.obs.gz",))[0], read_navigation([KAMAKURA / "nav.gz"])


def test_the_log_is_what_the_script_makes(encoder, rinex):
    assert encoder.encode_log(*rinex) == (KAMAKURA / "rover.ubx").read_bytes()


def test_observations_and_ephemerides_are_those_of_the_rinex(rinex):
    """To the last digit of RINEX, but for what u-blox keeps in whole numbers, and only of signals it has."""
    (obs, nav), (found, sent) = rinex, read_rover((KAMAKURA / "rover.ubx",))
    assert {name_signal(x) for x in obs.signal} - {name_signal(x) for x in found.signal} == {"1W", "2W", "8Q"}
    assert not found.remarks
    theirs = {key: i for i, key in enumerate(zip(obs.t + obs.zero, obs.satellite, obs.signal, strict=True))}
    keys = zip(found.t + found.zero, found.satellite, found.signal, strict=True)
    at = np.array([theirs[key] for key in keys])
    np.testing.assert_array_equal(found.code, obs.code[at])
    np.testing.assert_array_equal(found.carrier, obs.carrier[at])
    np.testing.assert_allclose(found.cn0, obs.cn0[at], atol=0.5)
    assert np.isnan(found.doppler).all()
    later = found.t > found.t[0]
    assert np.all(found.slip[later] | ~obs.slip[at][later])
    assert sent is not None
    np.testing.assert_allclose(sent.klobuchar, nav.klobuchar, rtol=1e-4)  # of which RINEX has five digits
    broadcast = {
        (s, toe): k
        for k, (s, toe, fnav) in enumerate(zip(*(nav.kepler[x] for x in ("satellite", "toe", "fnav")), strict=True))
        if not fnav
    }
    assert {name_satellite(s)[0] for s in sent.satellites} == {"G", "E", "J"}
    for k, key in enumerate(zip(sent.kepler["satellite"], sent.kepler["toe"], strict=True)):
        for name, value in sent.kepler.items():
            if name not in ("accuracy", "delay"):
                np.testing.assert_allclose(value[k], nav.kepler[name][broadcast[key]], rtol=1e-11, err_msg=name)
        own = nav.kepler["delay"][broadcast[key]]
        np.testing.assert_allclose(sent.kepler["delay"][k][:1], own[:1], rtol=1e-11)
