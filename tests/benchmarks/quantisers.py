"""Our quantiser against those that a user would pick instead, on one model and the same frames.

Run ``python -m tests.benchmarks.quantisers --help``; decides no test. Every finished step is kept in ``--out``: a run
that was cut short, or one of ``--only`` some quantisers, goes on from there. The table is of all that is there, each
model timed in turn with all others in one run.
"""

from __future__ import annotations

import hashlib
import json
import resource
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from edge.cli.source_names import public_name
from edge.evaluation.measure import Assessment, assess, measurement
from edge.evaluation.run import run_model
from edge.report.files import write_json, write_text
from edge.report.markdown import markdown_table
from edge.report.terminal import progress_bar, report_console, show_table
from edge.samples import calibration_source, measuring_source
from runtime.bench import bench_models, profile_directory
from runtime.contracts.errors import EdgeError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import MODEL_FILE, open_model_directory
from runtime.machine import package_version
from runtime.profile import int8_share
from runtime.sources.base import FrameSequence
from runtime.sources.factory import open_sequence
from runtime.turns import TOTAL
from tests.benchmarks.quantisers_job import Control, Job, narrowed
from tests.benchmarks.quantisers_peers import PEERS, Peer
from tests.benchmarks.quantisers_table import Row, comparison_table, machine_line

FLOAT = "float32"
CONTROL_SHIFT = 4
"""Control frames begin half of their own step, four eighths, later."""
TIMED_REPEAT = 3
RANKING_FRAMES, MAX_LAYERS = 4, 8
_CLOCKS = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)


@dataclass(frozen=True, slots=True)
class Bench:
    """A comparison in progress.

    Attributes:
        job: model and frames.
        validation: URI of the frames that measure.
        out: folder of model directories and records.
    """

    job: Job
    validation: str
    out: Path

    def quantise(self, name: str, *, again: bool = False) -> None:
        """Makes a peer's model, unless it is there; a failure becomes a row that says why."""
        if not again and (row := self.kept(name)) is not None and row.error is None:
            return
        peer, began_secs, began_cpu_secs = PEERS[name], time.perf_counter(), _cpu_secs()
        try:
            peer.make(self.job, self.out / name)
        except Exception as error:  # of foreign code: whatever it raises is this peer's result
            self.keep(name, Row(peer.title, peer.settings, error=_reason(error)))
            return
        row = Row(
            peer.title,
            peer.settings,
            wall_secs=time.perf_counter() - began_secs,
            cpu_secs=_cpu_secs() - began_cpu_secs,
            size_bytes=(self.out / name / MODEL_FILE).stat().st_size,
        )
        self.keep(name, row)

    def measure(self, names: Sequence[str]) -> None:
        """Detects in the measuring frames with FP32 and with each model that has not been measured on them."""
        shown = public_name(self.validation)
        rows = {name: row for name in names if (row := self.kept(name)) is not None and row.error is None}
        waiting = [name for name, row in rows.items() if row.measured_on != shown]
        base = self.kept(FLOAT)
        if not waiting and base is not None and base.measured_on == shown:
            return
        with open_sequence(self.validation) as source:
            model = self.job.model
            reference = self._assess(model.path, FLOAT, source)
            row = Row("FP32", "", size_bytes=model.model_path.stat().st_size)
            self.keep(FLOAT, row.measured(measurement(reference), source=shown, share=0.0))
            for name in waiting:
                try:
                    found = measurement(self._assess(self.out / name, name, source), reference)
                    share = int8_share(profile_directory(self.out / name, [source[0]]))
                except EdgeError as error:
                    self.keep(name, replace(rows[name], error=_reason(error)))
                else:
                    self.keep(name, rows[name].measured(found, source=shown, share=share))

    def rows(self, timed_frames: int) -> list[Row]:
        """FP32 and every peer of which there is a record, with latency unless ``timed_frames`` is 0."""
        found = {name: row for name in (FLOAT, *PEERS) if (row := self.kept(name)) is not None}
        sound = [name for name, row in found.items() if row.error is None]
        if timed_frames and FLOAT in sound:
            with open_sequence(self.validation) as source:
                pairs: list[StereoFrame] = [source[index] for index in range(min(timed_frames, len(source)))]
            paths = [self.job.model.path if name == FLOAT else self.out / name for name in sound]
            with progress_bar("timing", len(pairs) * TIMED_REPEAT) as step:
                timed = bench_models(paths, pairs, repeat=TIMED_REPEAT, progress=lambda done, total: step())
            for name, item in zip(sound, timed, strict=True):
                found[name] = replace(found[name], ms=item.stages[TOTAL].median, ratio=item.ratio)
        return list(found.values())

    def kept(self, name: str) -> Row | None:
        """The record of a peer, where it is of this model, these frames and settings."""
        path = self.out / f"{name}.json"
        if not path.is_file() or (name != FLOAT and not self._made(name, path)):
            return None
        record = json.loads(path.read_text(encoding="utf-8"))
        return Row(**record["row"]) if record["key"] == self._key(name) else None

    def keep(self, name: str, row: Row) -> None:
        """Writes a record."""
        write_json(self.out / f"{name}.json", {"key": self._key(name), "row": asdict(row)})

    def _made(self, name: str, path: Path) -> bool:
        return (self.out / name / MODEL_FILE).is_file() or json.loads(path.read_text())["row"]["error"] is not None

    def _key(self, name: str) -> str:
        """Hash of all that a record depends on, but for this project's own code: see ``--again``."""
        job, peer = self.job, PEERS.get(name, Peer("", "", None, lambda job, out: None))
        parts = [job.model.manifest.sha256[MODEL_FILE]]
        if name != FLOAT:
            parts += [public_name(job.calibration), str(job.frames), peer.settings]
            parts += [str(package_version(peer.needs))] if peer.needs else []
            parts += [public_name(job.control.uri), repr(replace(job.control, uri=""))] if peer.controlled else []
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _assess(self, path: Path, name: str, source: FrameSequence) -> Assessment:
        with progress_bar(f"measuring {name}", len(source)) as step:
            return assess(run_model(path, source, on_frame=step))


def main(
    model: Annotated[Path, typer.Option(help="Float model directory of `edge export`.")] = Path("out/compact-fp32"),
    calibration: Annotated[str, typer.Option(help="Calibration frames; default: the bundled calibration drive.")] = "",
    validation: Annotated[str, typer.Option(help="Frames that measure; default: the bundled measuring drive.")] = "",
    frames: Annotated[int, typer.Option(min=1, help="How many frames calibrate, at equal steps.")] = 48,
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(PEERS)}; again for more.")] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Quantise anew what is there, as after a change here.")
    ] = False,
    control_frames: Annotated[int, typer.Option(min=1, help="For accuracy control, from the calibration source.")] = 12,
    max_disagreement: Annotated[float, typer.Option(help="Its budget: per cent of detections that may differ.")] = 2.0,
    timed_frames: Annotated[int, typer.Option(min=0, help="For latency, three times each; 0: none.")] = 8,
    out: Annotated[Path, typer.Option(help="Models, records, results.json, table.md.")] = Path("out/quantisers"),
) -> None:
    """Compare quantisers on one model and the same frames; finished steps in --out are not repeated."""
    names = tuple(only or PEERS)
    unknown = [name for name in names if name not in PEERS]
    if unknown:
        raise typer.BadParameter(f"--only: found {unknown[0]!r}; expected of {', '.join(PEERS)}")
    frames_of = calibration or calibration_source()
    control = Control(
        uri=narrowed(frames_of, control_frames, shift=CONTROL_SHIFT),
        max_disagreement=max_disagreement,
        ranking_frames=min(RANKING_FRAMES, control_frames),
        max_layers=MAX_LAYERS,
    )
    job = Job(open_model_directory(model), narrowed(frames_of, frames), frames, control)
    bench = Bench(job, validation or measuring_source(), out)
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        bench.quantise(name, again=again)
    bench.measure(names)
    rows = bench.rows(timed_frames)
    table = comparison_table(rows, calibrated_on=f"{frames} frames of {public_name(frames_of)}")
    command = shlex.join(["python", "-m", "tests.benchmarks.quantisers", *sys.argv[1:]])
    facts = {"machine": machine_line(), "command": command}
    write_json(out / "results.json", {**facts, "rows": [asdict(row) for row in rows]})
    write_text(out / "table.md", markdown_table(table) + f"{facts['machine']}.\n")
    show_table(report_console(), table, text_columns=1)


def _cpu_secs() -> float:
    """Processor time of this process and of those that it waited for."""
    return sum(usage.ru_utime + usage.ru_stime for usage in map(resource.getrusage, _CLOCKS))


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [""]
    return str(error) if isinstance(error, EdgeError) else f"{type(error).__name__}: {lines[0]}"


if __name__ == "__main__":
    try:
        typer.run(main)
    except EdgeError as failure:
        typer.echo(f"error: {failure}", err=True)
        sys.exit(2)
