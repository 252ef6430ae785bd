"""What training any field has in common: pictures, the clock, Ctrl-C, and the comparison with views that were held out."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np

from epipole._jit import compile_seconds
from epipole.errors import WorkspaceError
from epipole.fields.photometric import likeness, psnr
from epipole.fields.training_view import TrainingView
from epipole.io.rgba_pictures import write_png
from epipole.pipelines.fields.checkpoints import Checkpoint
from epipole.pipelines.fields.config import FieldOptions
from epipole.pipelines.fields.pictures import FieldPictures, gather_field_pictures, is_model
from epipole.pipelines.sfm.run import reconstruct
from epipole.runs import Run, heeded_interrupts

METRICS, MODEL = "metrics.json", "sfm"
CURVE_POINTS = 200


@runtime_checkable
class Trainer(Protocol):
    """What is trained step by step."""

    background: np.ndarray
    num_steps: int

    def step(self, progress: float) -> float:
        """One step, at a share of the training; returns the loss."""

    def draw(self, view: TrainingView) -> np.ndarray:
        """(h, w, 3) the picture of a view."""

    def __len__(self) -> int:
        """Gaussians, or voxels."""


def pictures_of(source: Path, run: Run, wanted: FieldOptions) -> FieldPictures:
    """Cameras and pictures of a source; those of photographs are found first, in a folder beside."""
    if is_model(source):
        return gather_field_pictures(source, wanted)
    model = run.root / MODEL
    reconstruct(source, model, progress=run.job.progress)
    pictures = source if source.is_dir() else model / "images"
    return gather_field_pictures(model, wanted, pictures)


def background_of(wanted: FieldOptions, pictures: FieldPictures) -> np.ndarray:
    """(3,) white or black."""
    is_white = wanted.background == "white" or (wanted.background == "auto" and pictures.has_alpha)
    return np.full(3, 1.0 if is_white else 0.0, np.float32)


def train(
    trainer: Trainer, wanted: FieldOptions, run: Run, checkpoint: Checkpoint | None = None
) -> tuple[list[list[float]], bool]:
    """Steps until the time is over; seconds, step, loss and size along the way, and whether Ctrl-C ended it.

    Ctrl-C is heeded between two steps: in the middle of one the state would be torn. Pressed again it interrupts as usual.
    """
    limit, curve, earlier = wanted.seconds, list[list[float]](), 0.0
    if checkpoint is not None:
        earlier, curve = checkpoint.restore()
    if trainer.num_steps:
        run.warnings.append(f"an earlier training was ended at step {trainer.num_steps}, and goes on")
    begin, compiling = perf_counter(), compile_seconds()

    def seconds() -> float:
        return earlier + perf_counter() - begin - (compile_seconds() - compiling)

    def done() -> float:
        if limit is None:
            return trainer.num_steps / (wanted.steps or 1)
        return seconds() / limit

    is_over = False
    with heeded_interrupts() as is_pressed:
        while (share := done()) < 1.0 and not is_over:
            loss = trainer.step(share)
            is_over = is_pressed()
            if share * CURVE_POINTS >= len(curve):
                curve.append([seconds(), trainer.num_steps, loss, len(trainer)])
                try:
                    run.report("train", min(round(100 * share), 99), 100)
                except KeyboardInterrupt:  # by the caller's own callback
                    is_over = True
            if checkpoint is not None and (is_over or checkpoint.is_due()):
                _keep(checkpoint, seconds(), curve, run)
    if not is_over:
        run.report("train", 100, 100)
    return curve, is_over


def _keep(checkpoint: Checkpoint, seconds: float, curve: list[list[float]], run: Run) -> None:
    """Write the state; where that fails the training goes on, for what is learnt is worth more."""
    try:
        checkpoint.save(seconds, curve)
    except WorkspaceError as error:
        note = f"the training cannot be gone on with later: {error}"
        run.warnings += [] if note in run.warnings else [note]


def compared(trainer: Trainer, pictures: FieldPictures, run: Run) -> list[dict[str, Any]]:
    """Draw the held-out views into `test`, and say how like they are."""
    scores = []
    with run.stage("test"), run.folder.publish("test") as aside:
        for n, view in enumerate(pictures.test):
            drawn, truth = trainer.draw(view), view.over(trainer.background)
            name = f"{Path(view.name).with_suffix('')}.png".replace("/", "_")
            write_png(aside / "test" / name, np.rint(255 * np.clip(drawn, 0, 1)).astype(np.uint8))
            score = {"name": view.name, "psnr": psnr(drawn, truth), "ssim": likeness(drawn, truth).ssim}
            scores.append(score)
            run.report("test", n + 1, len(pictures.test))
    return scores


def finished(
    trainer: Trainer,
    pictures: FieldPictures,
    scores: list[dict[str, Any]],
    curve: list[list[float]],
    run: Run,
    **more: Any,
) -> dict[str, Any]:
    """Write `metrics.json` and end the run; the summary."""
    summary: dict[str, Any] = {
        **more,
        "num_train": len(pictures.train),
        "num_test": len(pictures.test),
        "steps": trainer.num_steps,
        "train_s": curve[-1][0] if curve else 0.0,
        "psnr": float(np.mean([one["psnr"] for one in scores])) if scores else None,
        "ssim": float(np.mean([one["ssim"] for one in scores])) if scores else None,
        "background": "white" if trainer.background[0] else "black",
        "timings_s": run.timings_s,
    }
    columns = ["s", "step", "loss", "size"]
    run.folder.write_json(METRICS, {**summary, "views": scores, "curve": {"columns": columns, "rows": curve}})
    run.finish(summary)
    return summary
