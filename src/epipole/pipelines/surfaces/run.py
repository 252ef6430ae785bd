"""The job `surface`: images in; depth of each view, a cloud and a mesh out."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Unpack

from epipole._checks import as_path
from epipole.config import options_of
from epipole.dense.volume_building import median_pixel
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError, WorkspaceError
from epipole.io.files import missing_in_words
from epipole.io.meshes.mesh_ply import write_mesh_ply
from epipole.io.meshes.usd import require_usd
from epipole.io.survey.point_clouds import require_laspy
from epipole.pipelines.surfaces.cloud_files import write_laz, write_ply
from epipole.pipelines.surfaces.cloud_stage import cloud_units
from epipole.pipelines.surfaces.config import STAGES, SurfaceConfig
from epipole.pipelines.surfaces.depth_stage import depth_units
from epipole.pipelines.surfaces.depth_views import DEPTHS, depth_views_text
from epipole.pipelines.surfaces.inputs import SurfaceInputs, surface_inputs
from epipole.pipelines.surfaces.mesh_stage import depth_images, first_view, mesh_of
from epipole.pipelines.surfaces.options import SurfaceKeywords
from epipole.pipelines.surfaces.page import render_page
from epipole.pipelines.surfaces.results import depth_figures, summary_of
from epipole.pipelines.surfaces.survey_stage import (
    check_map,
    check_survey,
    crs_of,
    notes_on_cells,
    require_survey_packages,
    write_survey,
)
from epipole.pipelines.surfaces.texture_stage import COARSE_TEXELS, texel_side, texture_of, write_textured
from epipole.pipelines.surfaces.view_files import view_of_file
from epipole.runs import (
    Job,
    PassedExecutor,
    ProgressCallback,
    Run,
    Unit,
    chosen_executor,
    ignore_progress,
    is_output_of,
    is_overwriting,
    open_run,
    read_mark,
)
from epipole.scene import Mesh
from epipole.scene.notebook import table_html
from epipole.scene.textured_mesh import TexturedMesh

WHERE = ("threads", "cluster", "shared_folder")
"""Options that do not change results."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceResult:
    """Result of `surface`, whose arrays are in the files of the output folder."""

    out: Path
    mesh: Mesh | None
    """None if it ended before the mesh."""
    summary: dict[str, Any]
    """As in `summary.json`."""
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        return f"SurfaceResult({self.summary.get('num_points', 0):,} points in {self.out})"

    def _repr_html_(self) -> str:
        rows = {name: self.summary.get(name) for name in ("num_views", "num_points", "num_faces")}
        return table_html("SurfaceResult", rows | {"warnings": len(self.warnings), "folder": self.out})


def surface(
    source: str | Path,
    out: str | Path,
    config: SurfaceConfig | None = None,
    progress: ProgressCallback = ignore_progress,
    *,
    executor: PassedExecutor | None = None,
    **options: Unpack[SurfaceKeywords],
) -> SurfaceResult:
    """Reconstruct surfaces: depth of each image, a cloud of all, and a mesh.

    Called again with the same options, an interrupted run continues with the images that are left.

    Args:
        source: a folder of photographs or a video, which is reconstructed first (`OUT/sfm`); an output folder of `reconstruct`; a COLMAP
            model with its images; or a transforms.json.
        out: output folder: `cloud.ply`, `mesh.ply`, `textured.glb`, `report.html`; for `until="survey"`, also `dsm.tif`,
            `dtm.tif`, `contours.gpkg`, `orthophoto.tif` and `cloud.laz`.
        config: options; None for the defaults.
        progress: called with the progress of each stage.
        executor: executor for images, instead of the config's choice, as for `reconstruct`.
        **options: single options by name, which override `config`: `until="cloud"`.

    Raises:
        NoModelError: the images cannot be reconstructed, or no two of them share points.
        ConfigError: an option is unknown or invalid.
        DegenerateGeometryError: no surface was seen by enough images.
        FileFormatError: the source cannot be read.
        WorkspaceError: the output folder cannot be used, or the disk is full.
    """
    wanted = options_of(SurfaceConfig, config, options, ["config", "progress", "executor"])
    wanted = replace(wanted, images=None if wanted.images is None else wanted.images.resolve())
    source, target = as_path(source), as_path(out)
    if not source.exists():
        raise FileFormatError(source, missing_in_words(source))
    _require_packages(wanted)
    _refuse_fewer_stages(target, wanted)
    settings = {"config": {name: value for name, value in asdict(wanted).items() if name not in WHERE}}
    job = Job(
        kind="surface",
        inputs=(source,),
        settings=settings,
        threads=wanted.threads,
        executor=chosen_executor(executor, wanted.cluster, has_shared_folder=wanted.shared_folder),
        progress=progress,
        has_log=True,
    )
    with open_run(job, target) as run:
        with run.stage("open"):
            run.warnings += wanted.unused()
            inputs = surface_inputs(source, run, wanted)
            if wanted.until == "survey":
                run.warnings += check_survey(inputs, wanted)
            elif wanted.laz and inputs.model.georeference is not None:
                run.warnings += check_map(inputs.model.georeference, wanted)
        run.warnings += inputs.warnings
        try:
            return _surface_of(inputs, wanted, run)
        finally:
            view_of_file.cache_clear()


def _refuse_fewer_stages(out: Path, config: SurfaceConfig) -> None:
    """Check that a run that ends earlier does not remove the results of later stages.

    Raises:
        WorkspaceError: it would, and `--overwrite` was not passed.
    """
    if is_overwriting() or not is_output_of(out, "surface"):
        return
    mark = read_mark(out)
    later = STAGES[STAGES.index(config.until) + 1 :]
    lost = [stage for stage in later if mark is not None and mark.files.get(stage)]
    if lost:
        raise WorkspaceError(
            f"{out} has results of later stages ({', '.join(lost)}), which a run until {config.until} would remove: choose another output"
            " folder, or pass --overwrite"
        )


def _require_packages(config: SurfaceConfig) -> None:
    """Check that the packages of the requested files are installed, before anything is computed.

    Raises:
        MissingDependencyError: one is not.
    """
    if config.until == "survey":
        require_survey_packages()
    if config.laz:
        require_laspy()
    if "usdz" in config.formats and STAGES.index(config.until) >= STAGES.index("texture"):
        require_usd()


def _surface_of(inputs: SurfaceInputs, config: SurfaceConfig, run: Run) -> SurfaceResult:
    last, units = STAGES.index(config.until), run.root / "units"
    with run.stage("depth"):
        depths = depth_units(inputs, units / "depth")
        run.do(list(depths.values()), "depth")
        figures = depth_figures(inputs, depths)
        figures.require_depth()
    with run.folder.publish("depth") as aside:
        (aside / DEPTHS).write_text(depth_views_text(inputs, depths, run.root), encoding="utf-8")
    _withdraw("cloud", run)
    facts: dict[str, Any] = {}
    clouds, mesh, sample = dict[int, Unit](), None, None
    if last >= STAGES.index("cloud"):
        with run.stage("cloud"):
            clouds = cloud_units(inputs, depths, units / "cloud")
            run.do(list(clouds.values()), "cloud")
            with run.folder.publish("cloud") as aside:
                facts["num_points"], sample = write_ply(aside, clouds)
                if _has_laz(config):
                    origin = inputs.model.georeference
                    write_laz(aside, clouds, origin, None if origin is None else crs_of(origin, config))
    if last >= STAGES.index("mesh"):
        with run.stage("mesh"):
            mesh, figures_of_mesh = mesh_of(inputs, depths, clouds, config, run)
            facts |= figures_of_mesh
            with run.folder.publish("mesh") as aside:
                view = first_view(inputs, mesh)
                write_mesh_ply(aside / "mesh.ply", mesh.vertices_in_world, mesh.faces, mesh.rgb, view)
    survey = None
    if mesh is not None and last >= STAGES.index("texture"):
        pixel = median_pixel(depth_images(inputs, depths, clouds))
        textured = _texture(mesh, inputs, depths, clouds, config, run)
        facts |= {} if textured is None else _texture_facts(textured, pixel, config, run)
        if textured is not None and config.until == "survey":
            run.report("survey", 0, 1)
            with run.stage("survey"), run.folder.publish("survey") as aside:
                survey = write_survey(aside, textured, clouds, inputs, pixel, config)
                facts |= survey.facts
            run.warnings += notes_on_cells(facts)
            run.report("survey", 1, 1)
    with run.stage("write"), run.folder.publish("report") as aside:
        summary = summary_of(inputs, figures, facts, run)
        page = render_page(inputs, depths, figures, sample, summary, survey)
        (aside / "report.html").write_text(page, encoding="utf-8", errors="replace")
    run.finish(summary)
    return SurfaceResult(run.root, mesh, summary, tuple(run.warnings))


def _has_laz(config: SurfaceConfig) -> bool:
    """Whether the cloud stage writes LAZ; the survey writes its own, cropped."""
    return config.laz and config.until != "survey"


def _withdraw(first: str, run: Run) -> None:
    """Remove the results of an earlier run from this stage on: they do not belong to the new ones."""
    for group in STAGES[STAGES.index(first) :]:
        with run.folder.publish(group):
            pass


def _texture(
    mesh: Mesh,
    inputs: SurfaceInputs,
    depths: dict[int, Unit],
    clouds: dict[int, Unit],
    config: SurfaceConfig,
    run: Run,
) -> TexturedMesh | None:
    """The textured mesh, as written; a mesh that cannot be textured stays without, with a warning, unless survey products need the colors."""
    with run.stage("texture"):
        try:
            textured = texture_of(mesh, inputs, depths, clouds, config, run)
        except (ConfigError, DegenerateGeometryError) as error:
            if config.until == "survey":
                raise
            run.warnings.append(f"the mesh has no texture: {error}")
            return None
        with run.folder.publish("texture") as aside:
            write_textured(aside, textured, inputs.up, config)
        return textured


def _texture_facts(textured: TexturedMesh, pixel: float, config: SurfaceConfig, run: Run) -> dict[str, Any]:
    """Size of the texture and of its texels, with a warning if they are much larger than the pixels of the images."""
    height, width = textured.textures[0].shape[:2]
    texel = texel_side(textured)
    if texel > COARSE_TEXELS * pixel:
        results = "the texture and the orthophoto are" if config.until == "survey" else "the texture is"
        run.warnings.append(
            f"{results} coarser than the images: a texel is as large as {texel / pixel:.1f} pixels of the depth images; pass a larger texture (--texture-px, now {config.texture_px})"
        )
    return {"texture_size_px": [width, height], "texel": texel}
