"""Small tools of the core's tests: numerical derivatives, random states, dense least squares."""

from __future__ import annotations

import ast
import io
import os
import resource
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graphnav.app import cli
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import GraphnavError
from graphnav.core.notes import get_key
from graphnav.core.state import BLOCKS, DIM, States
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.recording import Imu, ImuNoise, Recording

Array = NDArray[np.float64]

FRAME = LocalFrame(np.array([np.radians(48.1), np.radians(11.6), 500.0]))
# central-difference steps per error-state entry: rad, m, m/s, m/s^2, rad/s
STEPS = np.repeat([1e-5, 1e-1, 1e-1, 1e-3, 1e-5], 3)


@contextmanager
def refused(key: str, kind: type[GraphnavError], *names: str) -> Iterator[pytest.ExceptionInfo[GraphnavError]]:
    """An error of this key and kind in one line that names files, lines, keys and values; its other words are free."""
    with pytest.raises(kind) as caught:
        yield caught
    sentence = str(caught.value)
    assert caught.value.key == key, f"{caught.value.key!r}: {sentence}"
    assert "\n" not in sentence
    assert [name for name in names if name not in sentence] == [], sentence


@cache
def parse_code(path: Path) -> list[ast.AST]:
    """All nodes of a file of the code."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def refuse_command(capsys: pytest.CaptureFixture[str], key: str, *arguments: str | Path) -> str:
    """The one line on stderr of a command that ends with exit code 2 for an error of this key; "" is wrong usage."""
    keys: list[str] = []
    program = cli.build_program()

    def watched(*words: Any, **how: Any) -> Any:
        try:
            return program(*words, **how)
        except GraphnavError as error:
            keys.append(error.key)
            raise

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "build_program", lambda: watched)
        assert cli.run([str(a) for a in arguments]) == 2
    out, said = capsys.readouterr()
    assert out == ""
    assert said.startswith("graphnav: ")
    assert keys == [key] * bool(key), said
    assert said.count("\n") == 1
    return said


def run_here(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """A command in this process, which has imported everything already: its exit code and what it prints."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = cli.run([str(word) for word in words])
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def assert_told(notes: Iterable[str], key: str, *names: str) -> None:
    """Some note has this key and names files, lines and values; its other words are free."""
    notes = list(notes)
    found = [note for note in notes if get_key(note) == key and all(name in note for name in names)]
    assert found, [(get_key(note), str(note)) for note in notes]


def difference(f: Callable[[Array], Array], steps: Array, width: int | None = None) -> Array:
    """Central differences of ``f(delta)`` about zero: an array shaped like f with one more axis, last."""
    width = len(steps) if width is None else width
    columns = []
    for k in range(width):
        d = np.zeros(width)
        d[k] = steps[k]
        columns.append((f(d) - f(-d)) / (2.0 * steps[k]))
    return np.stack(columns, -1)


def random_rotations(rng: np.random.Generator, n: int) -> Array:
    """(n, 3, 3), spread over all of SO(3)."""
    return rotation.from_quaternion(rng.standard_normal((n, 4)))


def random_states(rng: np.random.Generator, n: int, span: float = 2e4) -> States:
    """n states anywhere within `span` m, up to highway speed, with biases."""
    p = rng.uniform(-span, span, (n, 3)) * [1.0, 1.0, 0.01]
    return States(
        random_rotations(rng, n),
        p,
        15.0 * rng.standard_normal((n, 3)),
        0.1 * rng.standard_normal((n, 3)),
        0.01 * rng.standard_normal((n, 3)),
    )


def random_imu(rng: np.random.Generator, seconds: float, rate: float = 100.0, noise: ImuNoise | None = None) -> Imu:
    """Violent motion: every sample turns and pushes anew."""
    count = round(seconds * rate)
    gyro = 0.7 * rng.standard_normal((count, 3))
    accel = 3.0 * rng.standard_normal((count, 3)) + [0.5, -0.3, 9.8]
    return Imu(np.arange(1, count + 1) / rate, gyro, accel, noise or ImuNoise())


def at_rate(recording: Recording, rate: float) -> Recording:
    """The same recording of an IMU that samples less often: rows are means, so means of them are its rows."""
    imu = recording.imu
    n = round(1.0 / (rate * float(np.median(np.diff(imu.t)))))
    count = len(imu.t) // n

    def mean(x: Array) -> Array:
        return x[: count * n].reshape(count, n, 3).mean(axis=1)

    return replace(
        recording, imu=replace(imu, t=imu.t[n - 1 : count * n : n], gyro=mean(imu.gyro), accel=mean(imu.accel))
    )


def thin_fixes(recording: Recording, every: int) -> Recording:
    """The recording with one fix of so many."""
    assert recording.gnss is not None
    return replace(recording, gnss=pick_fixes(recording.gnss, np.arange(0, len(recording.gnss.t), every)))


def forget_residuals(recording: Recording) -> Recording:
    """The recording with fixes that do not tell the residuals of their pseudoranges."""
    assert recording.gnss is not None
    return replace(recording, gnss=replace(recording.gnss, residual_rms=None))


def truth_states(truth: Trajectory, t: Array, frame: LocalFrame) -> States:
    """The truth as states in a navigation frame, straight between its rows, of which there is one a few ms away."""
    i = np.clip(np.searchsorted(truth.t, t - 1e-6), 1, len(truth.t) - 1)
    w = ((t - truth.t[i - 1]) / (truth.t[i] - truth.t[i - 1]))[:, None]
    assert np.all((w > -1e-3) & (w < 1.001)), "no truth there"
    between = (w[:, 0] > 1e-3) & (w[:, 0] < 0.999)
    assert np.all((truth.t[i] - truth.t[i - 1])[between] < 0.011), "the truth is too coarse"

    def at(x: Array | None) -> Array:
        return np.zeros((len(t), 3)) if x is None else (1 - w) * x[i - 1] + w * x[i]

    p = at(frame.from_llh(truth.llh))
    R_nl = np.swapaxes(frame.R_ln(p), -1, -2)
    rph = truth.rph[i - 1] + w * rotation.wrap(truth.rph[i] - truth.rph[i - 1])
    v = np.einsum("kij,kj->ki", R_nl, at(truth.v))
    return States(R_nl @ rotation.from_rph(rph), p, v, at(truth.accel_bias), at(truth.gyro_bias))


def errors(solution: Solution, truth: Trajectory) -> tuple[Array, Array, Array, Array]:
    """(position error e n u, its sigma, roll-pitch-heading error, its sigma) at every keyframe; m and rad."""
    mine = solution.trajectory()
    true = truth_states(truth, mine.t, solution.frame)
    R_ln = solution.frame.R_ln(true.p)
    position = np.einsum("kij,kj->ki", R_ln, solution.states.p - true.p)
    assert mine.sd_p is not None
    assert mine.sd_rph is not None
    rph = rotation.to_rph(R_ln @ true.R_nb)
    return position, mine.sd_p, rotation.wrap(mine.rph - rph), mine.sd_rph


Factor = tuple[dict[int, Array], Array]  # {key: A (m, k)}, b (m,)


def factors(problem: Problem, states: States, values: dict[str, Array]) -> tuple[list[Factor], list[int]]:
    """All rows of a problem, whitened, factor by factor, and the width of every variable.

    Key k for keyframe k, then one per node of each parameter. Written from `Constraint.linearize` and
    `Motion.linearize` with none of the solvers' code. `values` holds (nodes, k) per parameter.
    """
    K = len(problem.t)
    key, node, widths = {}, {}, [DIM] * K
    for chain in problem.chains:
        key[chain.parameter.name], node[chain.parameter.name] = len(widths), chain.node
        widths += [chain.parameter.size] * len(chain.t)
    out: list[Factor] = []
    scale = values["imu_scale"][0] if "imu_scale" in key else None
    r, Ji, Jj, Js = problem.motion.linearize(states, scale)
    for k in range(K - 1):
        W = np.linalg.inv(np.linalg.cholesky(problem.intervals.covariance[k]))
        blocks = {k: W @ Ji[k], k + 1: W @ Jj[k]}
        if "imu_scale" in key:
            blocks[key["imu_scale"]] = W @ Js[k]
        out.append((blocks, -W @ r[k]))
    for rows in (problem.prior, *problem.constraints):
        given = {p.name: values[p.name][node[p.name][rows.keyframe]] for p in rows.parameters}
        linear = rows.linearize(states[rows.keyframe], given, slice(None))
        for i in range(len(rows)):
            white = 1.0 / linear.sigma[i][:, None]
            state = np.zeros((len(white), DIM))
            blocks = {int(rows.keyframe[i]): state}
            for name, J in linear.jacobians.items():
                if name in BLOCKS:
                    state[:, BLOCKS[name]] = white * J[i]
                else:
                    blocks[key[name] + int(node[name][rows.keyframe[i]])] = white * J[i]
            out.append((blocks, -linear.residual[i] * white[:, 0]))
    for chain in problem.chains:
        p, x, first = chain.parameter, values[chain.parameter.name], key[chain.parameter.name]
        if p.begins is not None:
            out += [({first + j: np.diag(1 / p.sigma[j])}, (p.initial[j] - x[j]) / p.sigma[j]) for j in range(len(x))]
            continue
        out.append(({first: np.diag(1.0 / p.sigma)}, (p.initial - x[0]) / p.sigma))
        for j in range(len(chain.t) - 1):
            # a Gauss-Markov process, exact between any two times (Gelb 1974, eq. 3.8-8)
            dt = chain.t[j + 1] - chain.t[j]
            decay = np.exp(-dt / p.correlation_time) if p.correlation_time else 1.0
            q = p.sigma**2 * (1 - decay**2) if p.correlation_time else p.walk**2 * dt * np.ones_like(p.sigma)
            W = np.diag(1.0 / np.sqrt(q))
            out.append(({first + j: -decay * W, first + j + 1: W}, W @ (decay * x[j] - x[j + 1])))
    return out, widths


def dense(parts: list[Factor], widths: list[int]) -> tuple[Array, Array]:
    """Solution and covariance of a small system by one dense QR, columns scaled to keep its digits."""
    edge = np.cumsum([0, *widths])
    A = np.zeros((sum(len(b) for _, b in parts), edge[-1]))
    right = np.concatenate([b for _, b in parts])
    at = 0
    for blocks, b in parts:
        for key, block in blocks.items():
            A[at : at + len(b), edge[key] : edge[key + 1]] = block
        at += len(b)
    size = np.linalg.norm(A, axis=0)
    Q, R = np.linalg.qr(A / size)
    root = np.linalg.inv(R) / size[:, None]
    return root @ (Q.T @ right), root @ root.T


def same_recording(a: Recording, b: Recording, angle: float = 0.0) -> None:
    """Every number of two recordings is the same; positions may differ by `angle` (rad)."""
    assert (a.name, a.platform, a.gps_zero) == (b.name, b.platform, b.gps_zero)
    for sensor in ("imu", "gnss", "odometer", "truth"):
        one, other = getattr(a, sensor), getattr(b, sensor)
        assert (one is None) == (other is None), sensor
        if one is None:
            continue
        for key, value in other.__dict__.items():
            if key == "R_bs":
                continue  # body axes are written
            if isinstance(value, np.ndarray):
                tolerance = angle if key == "llh" else 0.0
                np.testing.assert_allclose(getattr(one, key), value, 0.0, tolerance, err_msg=f"{sensor}.{key}")
            else:
                assert getattr(one, key) == value, f"{sensor}.{key}"


def full_disk() -> dict[str, Any]:
    """Arguments with which `subprocess` starts a program that finds the disk full after 20 kB: a limit of the system.

    It keeps no bytecode: cut short there, it would end every program after it.
    """
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # noqa: E731
    return {"preexec_fn": limit, "env": {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}}


def find_steady_motion(recording: Recording, seconds: float, slowest: float) -> Array:
    """(2,) s, the span in which the speed of the truth changes least."""
    truth = recording.truth
    assert truth is not None
    assert truth.llh is not None
    inside = (truth.t > recording.start + 20.0) & (truth.t < recording.end - 20.0)
    t, p = truth.t[inside], LocalFrame(truth.llh[0]).from_llh(truth.llh[inside])
    every = max(round(1.0 / np.median(np.diff(t))), 1)
    t, v = t[every::every], np.diff(p[::every], axis=0) / np.diff(t[::every])[:, None]
    n = int(seconds)
    scatter = [np.std(v[k : k + n], axis=0).max() for k in range(len(v) - n)]
    slow = [np.linalg.norm(v[k : k + n], axis=1).min() < slowest for k in range(len(v) - n)]
    k = int(np.argmin(np.where(slow, np.inf, scatter)))
    return np.array([t[k] - 0.5, t[k] - 0.5 + seconds])
