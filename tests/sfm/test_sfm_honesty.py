"""What a result says of itself."""

from epipole import reconstruct
from epipole.pipelines.sfm.config import MapperConfig, ReconstructConfig


def test_a_model_tells_how_far_it_agrees_with_its_matches(reconstructed):
    assert 0.9 < reconstructed.summary["models"][0]["match_agreement"] <= 1.0
    assert reconstructed.warnings == ()


def test_a_model_that_disagrees_is_kept_with_a_warning(rendered, out_of_six):
    strict = MapperConfig(min_final_agreement=0.9999, restarts=0)
    result = reconstruct(rendered, out_of_six, ReconstructConfig(mapper=strict))
    assert result.model.is_registered().all()
    assert any("of its matches" in warning for warning in result.warnings)
    assert "of its matches" in (out_of_six / "report.html").read_text(encoding="utf-8")
