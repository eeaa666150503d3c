"""One run's innovations differentiated in many parameters at once, the filter's gains held."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from coax_env.estimation import frozen_gains
from coax_env.estimation.beginnings import Asked, Beginning, Moved, Sums, beginnings_pass
from coax_env.estimation.late_readings import rest_of
from coax_env.estimation.pass_data import Path, RunData
from coax_env.estimation.run_passes import Buffers, RunPass, RunPasses, gains_of, trace_of
from coax_env.estimation.sparse import add_gram, aligned, padded
from coax_env.estimation.state_space import FreeParameter, Model, Noise
from coax_env.kernel.simd import SIMD_WIDTH

BLOCK = 2.0  # [s] of the blocks whose scores are taken as independent
BLOCKS_AT_ONCE = 5  # whose signatures are held at a time: 7 MB at 100 Hz with every parameter
NONE_KEPT = frozen_gains.Kept(np.zeros((0, 0, 0), np.float32), np.zeros(0, np.int64))
DIVERGED = 1e6  # whitened innovations [std] that only a diverging mean has


@dataclass(frozen=True)
class ParameterMoves:
    """Each free parameter moved: vectors (np,) with one of them moved by steps (k,).

    probed: (k,) where a finite step is needed. reading_only: (k,) which never move the state.
    """

    vectors: list[np.ndarray]
    steps: np.ndarray
    probed: np.ndarray
    reading_only: np.ndarray


@dataclass(frozen=True)
class LinearisedRun:
    """One run's part of `Linearised`, its blocks' slopes with it.

    run, path: its pass. J: (readings, padded) signatures of its last blocks, k of them, then the
    innovations. wild: (k,) whose signatures were not finite.
    """

    run: RunPass
    path: Path
    J: np.ndarray
    wild: np.ndarray
    information: np.ndarray
    by_channel: np.ndarray
    blocks: np.ndarray


def moves_of(
    model: Model, values: Mapping[str, float], noise: Noise, free: Sequence[FreeParameter]
) -> ParameterMoves:
    """How far each parameter is moved, and the model's vectors then.

    Args:
        model: whose parameters they are. values: of all parameters, by name.
        noise: levels of process and reading noise. free: the parameters.
    """
    probed = np.array([abs(values[f.name] - f.value) < 0.25 * abs(f.probe) for f in free], bool)
    steps = np.array([f.probe if probed[k] else 0.02 * f.std for k, f in enumerate(free)])
    over = np.array([values[f.name] + steps[k] > f.upper for k, f in enumerate(free)], bool)
    steps[over] *= -1.0
    vectors = [
        model.vector({**values, f.name: values[f.name] + step}, noise)
        for f, step in zip(free, steps, strict=True)
    ]
    reading_only = np.array([f.reading_only for f in free], bool)
    return ParameterMoves(vectors, steps, probed, reading_only)


def linearise_run(
    runs: RunPasses,
    i: int,
    p: np.ndarray,
    noise: Noise,
    moves: ParameterMoves,
    buffers: Buffers,
    at_once: int,
    kept: frozen_gains.Kept = NONE_KEPT,
) -> LinearisedRun:
    """One run filtered and linearised.

    Args:
        runs: model and records. i: which. p: (np,) the parameters. noise: levels.
        moves: `moves_of` what is differentiated in.
        buffers: for what is gone with the next pass in them.
        at_once: blocks whose signatures are in memory together. kept: states' derivatives, out.
    """
    run, path = runs.filter_run(i, p, noise, Buffers(), buffers)
    count, edges, before = len(moves.vectors), *_block_edges(run)
    width = padded(count + 1)
    products, blocks = np.zeros((width, width)), np.zeros((edges.size - 1, count))
    by_channel = np.zeros((count, run.innovations.shape[1]))
    J = np.zeros((0, width))
    if np.isfinite(run.log_likelihood):
        signatures = signatures_of(runs, i, run, path, p, moves, by_channel)
        probed = _probed_signatures(runs, i, run, p, moves, by_channel)
        e = run.innovations[np.isfinite(run.innovations)]
        for first in range(0, edges.size - 1, at_once):
            own = edges[first : first + at_once + 1]
            since, until = before[own[0]], before[own[-1]]
            J = buffers.array("J", (int(until - since), width))
            J[:, count:] = 0.0
            J[:, count] = e[since:until]
            J[:, np.flatnonzero(moves.probed)] = probed[since:until]
            signatures(frozen_gains.Portion(int(own[0]), int(own[-1]), int(since)), J, kept)
            for b, (a, z) in enumerate(pairwise(before[own] - since), first):
                of_block = np.zeros((width, width))
                add_gram(J[a:z], count, of_block)
                blocks[b] = of_block[:count, count]
                products += of_block
    information = products[:count, :count]
    information = np.triu(information) + np.triu(information, 1).T
    wild = ~np.isfinite(np.diag(information))
    information[wild] = information[:, wild] = 0.0
    by_channel[wild] = 0.0
    blocks[:, wild] = 0.0
    return LinearisedRun(run, path, J, wild, information, by_channel, blocks)


def signatures_of(
    runs: RunPasses,
    i: int,
    run: RunPass,
    path: Path,
    p: np.ndarray,
    moves: ParameterMoves,
    by_channel: np.ndarray,
) -> Callable[[frozen_gains.Portion, np.ndarray, frozen_gains.Kept], None]:
    """Derivatives of a run's whitened innovations where a small step does.

    Args:
        runs: model and records. i: which. run, path: its pass. p: (np,) the parameters there.
        moves: of the parameters. by_channel: (k, m), in place.

    Returns:
        what puts those of a portion of the run, one after the other, into columns of J, adds their
        squares, by channel, to rows of `by_channel`, and keeps the state's derivatives.
    """
    columns = np.flatnonzero(~moves.probed)
    if not columns.size:
        return lambda portion, J, kept: None
    columns = columns[np.argsort(~moves.reading_only[columns], kind="stable")]
    p = rest_of(runs.model, run.record, p)
    vectors = [rest_of(runs.model, run.record, moves.vectors[k]) for k in columns]
    sets, which = [run.inputs], np.zeros(columns.size, np.int64)
    for k, vector in enumerate(vectors):
        inputs = _inputs(runs, run, p, vector)
        if not np.array_equal(inputs, run.inputs):
            which[k] = len(sets)
            sets.append(inputs)
    moved = frozen_gains.Moves(
        np.array(vectors), moves.steps[columns], moves.reading_only[columns],
        np.array(sets), which, columns,
    )  # fmt: skip
    s = aligned(runs.compiled.exact.size, padded(columns.size + 1))
    trace = trace_of(run, path)

    def of_portion(portion: frozen_gains.Portion, J: np.ndarray, kept: frozen_gains.Kept) -> None:
        frozen_gains.signature_pass(
            runs.compiled,
            runs.intervals[i],
            trace,
            p,
            moved,
            runs.refresh[i],
            portion,
            s,
            J,
            by_channel,
            kept,
        )

    return of_portion


def _probed_signatures(
    runs: RunPasses,
    i: int,
    run: RunPass,
    p: np.ndarray,
    moves: ParameterMoves,
    by_channel: np.ndarray,
) -> np.ndarray:
    """The same where a finite step is needed, by a mean pass each: (readings, probed)."""
    there = np.isfinite(run.innovations)
    channel, e = np.nonzero(there)[1], run.innovations[there]
    columns = np.flatnonzero(moves.probed)
    found = np.zeros((e.size, columns.size))
    moved = _moved_innovations(runs, i, run, p, [moves.vectors[k] for k in columns])
    for column, (k, innovations) in enumerate(zip(columns, moved, strict=True)):
        change = innovations - e
        if np.abs(change).max(initial=0.0) < DIVERGED:
            change /= moves.steps[k]
            found[:, column] = change
            by_channel[k] = np.bincount(channel, change**2, by_channel.shape[1])
    return found


def _moved_innovations(
    runs: RunPasses, i: int, run: RunPass, p: np.ndarray, vectors: Sequence[np.ndarray]
) -> Iterator[np.ndarray]:
    """Innovations (readings,) with other parameters, gains frozen; not finite where it diverged."""
    there = np.isfinite(run.innovations)
    if not runs.compiled.has_lanes:
        e = np.zeros(there.shape)
        for vector in vectors:
            yield e[there] if runs.frozen(i, run, vector, e) else np.full(there.sum(), np.nan)
        return
    data, gains = RunData(runs.intervals[i], run.inputs, run.record.z), gains_of(run)
    p = rest_of(runs.model, run.record, p)
    vectors = [rest_of(runs.model, run.record, vector) for vector in vectors]
    for first in range(0, len(vectors), SIMD_WIDTH):
        some = vectors[first : first + SIMD_WIDTH]
        lanes = [*some, *[p] * (SIMD_WIDTH - len(some))]
        e = np.zeros((int(there.sum()), SIMD_WIDTH))
        frozen_gains.mean_passes(
            runs.compiled, data, runs.starts[i][0], p, np.array(lanes).T.copy(),
            np.array([_inputs(runs, run, p, vector) for vector in lanes]),
            gains, runs.refresh[i], e,
        )  # fmt: skip
        yield from e.T[: len(some)]


def _inputs(runs: RunPasses, run: RunPass, p: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A run's inputs with the parameters `vector`, known those with `p`."""
    places = getattr(runs.model, "input_places", None)
    if places is not None and np.array_equal(p[places], vector[places]):
        return run.inputs
    return runs.model.inputs(run.record, vector)


def beginnings_of_run(
    runs: RunPasses,
    i: int,
    of: LinearisedRun,
    rows: np.ndarray,
    kept: frozen_gains.Kept,
    asked: Asked,
) -> list[Beginning]:
    """What parameters would do if they moved from some rows of a run on; none where it diverged.

    Args:
        runs: model and records. i: the run. of: it linearised, all blocks in memory. rows: (a,) rising.
        kept: the states' derivatives at these rows. asked: what is wanted of each row.
    """
    if not np.isfinite(of.run.log_likelihood):
        return []
    k, width = of.wild.size, of.J.shape[1]
    of.J[:, :k][:, of.wild] = kept.s[:, :, :k][:, :, of.wild] = 0.0
    a, pairs = rows.size, asked.first.size
    sums = Sums(
        np.zeros((a, width)), np.zeros((a, asked.beside.size, width)), np.zeros((a, pairs)),
        np.zeros((a, pairs)),
    )  # fmt: skip
    beginnings_pass(trace_of(of.run, of.path), runs.refresh[i], Moved(of.J, kept), asked, sums)
    return [
        Beginning(i, int(row), slope[:k], across[:, :k].T, crossed, own)
        for row, slope, across, crossed, own in zip(rows, *sums, strict=True)
    ]


def blocks_of(t: np.ndarray, seconds: float = BLOCK) -> np.ndarray:
    """The block of time that each row of a run is in (n,).

    Args:
        t: (n,) of its rows [s]. seconds: of a block.
    """
    return ((t - t[0]) / seconds).astype(np.int64)


def _block_edges(run: RunPass) -> tuple[np.ndarray, np.ndarray]:
    """First rows of blocks of BLOCK seconds, and the end (blocks + 1,); readings before each row."""
    t = run.record.t
    edges = np.searchsorted(t, np.arange(t[0] + BLOCK, t[-1], BLOCK))
    readings = np.isfinite(run.innovations).sum(1)
    return np.array([0, *edges, t.size]), np.append(0, np.cumsum(readings))
