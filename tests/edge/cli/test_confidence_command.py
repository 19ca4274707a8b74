"""``edge confidence`` on the bundled model and drive, and what is refused."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

from edge.cli.main import app
from edge.evaluation import confidence_fit
from edge.evaluation.confidence_fit import ConfidenceFit
from edge.samples import measuring_source
from runtime.contracts.confidence import read_confidence
from runtime.refinement import FEATURES

MODEL = str(files("edge.zoo") / "compact-int8")


def confidence(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["confidence", *(str(word) for word in words)])
    return result.exit_code, result.stderr


def test_weights_of_the_bundled_drive(tmp_path: Path) -> None:
    out = tmp_path / "new" / "confidence.json"
    code, told = confidence(MODEL, "--source", measuring_source(), "--out", out)
    assert code == 0, told
    record = read_confidence(out)
    assert set(record.weights) == {"Car", "Pedestrian"} and len(record.weights["Car"]) == len(FEATURES) + 1
    assert record.weights["Car"][FEATURES.index("logit")] > 0 > record.weights["Car"][FEATURES.index("log depth")]
    assert record.facts["frames"] == "48"
    assert "Cyclist keeps the network's score" in told  # too few of them in it
    code, told = confidence(MODEL, "--source", measuring_source(), "--out", out)
    assert code == 2 and "--overwrite" in told


def test_what_cannot_be_learned(tiny_model: Path, tiny_drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "confidence.json"
    code, told = confidence(tiny_model, "--source", f"kitti-object:{tiny_drive}", "--out", out)
    assert code == 2 and "refines no depths" in told
    code, told = confidence(MODEL, "--source", measuring_source(), "--out", out, "--classes", "Tram")
    assert code == 2 and "does not know Tram" in told
    drive = f"{measuring_source()}?limit=4"
    code, told = confidence(MODEL, "--source", drive, "--out", out, "--classes", "Cyclist")
    assert code == 2 and "boxes of Cyclist, expected at least 50" in told
    code, told = confidence(MODEL, "--source", f"{measuring_source()}?limit=1", "--out", out)
    assert code == 2 and "expected at least 50" in told
    assert not out.exists()


def test_a_class_that_learns_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def learned_badly(*given: object) -> ConfidenceFit:
        return ConfidenceFit(str(given[-1]), (0.0,) * (len(FEATURES) + 1), 100, 50, 0.3, 0.3)

    monkeypatch.setattr(confidence_fit, "fit_confidence", learned_badly)
    out = tmp_path / "confidence.json"
    code, told = confidence(MODEL, "--source", f"{measuring_source()}?limit=1", "--out", out)
    assert code == 2 and "Car keeps the network's score" in told and "found no class" in told
    assert not out.exists()


@pytest.mark.parametrize("words", [(), (MODEL, "--out", "x.json")])
def test_missing_words(words: tuple[str, ...]) -> None:
    assert confidence(*words)[0] == 2
