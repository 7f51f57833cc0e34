"""`choose.json`: the models compared, their tests, the chosen model and the reasons."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from adjust.model_selection.candidates import Candidate, Model
from adjust.model_selection.cross_validation import CrossValidation
from adjust.model_selection.model_choice import Choice
from pipeline.results.record_json import FOREIGN, Number, NumberOrNone, Whole, read_record, record_from


@dataclass(frozen=True)
class ModelRecord:
    """Film transformation, distortion family with its estimated parameters, and terms of scanner errors by scanner."""

    transformation: str
    family: str
    parameters: tuple[str, ...]
    bends: Mapping[str, tuple[str, ...]]

    @classmethod
    def from_model(cls, model: Model) -> "ModelRecord":
        return record_from(cls, model, bends=dict(model.bends))


@dataclass(frozen=True)
class ParameterCorrelation:
    """Two highly correlated parameters."""

    parameters: tuple[str, str]
    correlation: Number


@dataclass(frozen=True, kw_only=True)
class CandidateRecord:
    """Adjusted model. problem: why it has no solution; the statistics are then None."""

    name: str
    transformation: str
    family: str
    parameters: tuple[str, ...]
    bends: Mapping[str, tuple[str, ...]]
    problem: str = ""
    observations: Whole | None = None
    unknowns: Whole | None = None
    redundancy: Whole | None = None
    vpv: NumberOrNone = None
    sigma0: NumberOrNone = None
    aic: NumberOrNone = None
    aicc: NumberOrNone = None
    cross_validation: Annotated[CrossValidation, FOREIGN] | None = field(default_factory=lambda: None)
    correlated: tuple[ParameterCorrelation, ...] | None = None
    warnings: tuple[str, ...] | None = None

    @classmethod
    def from_candidate(cls, candidate: Candidate) -> "CandidateRecord":
        model = {"name": candidate.model.name, **vars(ModelRecord.from_model(candidate.model))}
        if candidate.problem:
            return cls(**model, problem=candidate.problem)
        correlated = tuple(ParameterCorrelation((a, b), rho) for a, b, rho in candidate.correlated)
        return record_from(cls, candidate, **model, correlated=correlated)


@dataclass(frozen=True)
class ModelTest:
    """F-test of a model against one with more parameters. degrees: of freedom, numerator and denominator."""

    simpler: str
    richer: str
    F: Number
    degrees: tuple[Whole, Whole]
    p: Number


@dataclass(frozen=True, kw_only=True)
class ChoiceRecord:
    """Model choice as stored. given: the model in the project; made_from: fingerprints of the input."""

    reseau: str = ""
    made_from: Mapping[str, str] = field(default_factory=dict)
    chosen: ModelRecord | None
    given: ModelRecord
    verdict: str
    reasons: tuple[str, ...]
    candidates: tuple[CandidateRecord, ...]
    tests: tuple[ModelTest, ...]


def choice_record(choice: Choice, made_from: Mapping[str, str]) -> ChoiceRecord:
    """Convert a choice to its record."""
    return ChoiceRecord(
        reseau=version("reseau"),
        made_from=made_from,
        chosen=ModelRecord.from_model(choice.chosen.model) if choice.chosen else None,
        given=ModelRecord.from_model(choice.given),
        verdict=choice.verdict,
        reasons=choice.reasons,
        candidates=tuple(map(CandidateRecord.from_candidate, choice.candidates)),
        tests=tuple(ModelTest(t.simpler.name, t.richer.name, t.f, t.degrees, t.p) for t in choice.tests),
    )


def read_choice(path: Path) -> ChoiceRecord:
    """Read `choose.json`. Raises FileNotFoundError, and InputError for invalid content."""
    return read_record(ChoiceRecord, path, "Run `reseau choose` again; it writes this file.")
