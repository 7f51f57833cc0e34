"""Tables of results for pandas, where it is installed."""

from typing import Any

import numpy as np

from adjust.problem.estimates import Estimates
from adjust.problem.observations import Observations
from adjust.quality.run import Residuals


def data_frame(columns: dict[str, Any]) -> Any:
    """Make a pandas.DataFrame. Raises ImportError without pandas."""
    try:
        import pandas as pd
    except ImportError:
        raise ImportError("Tables need pandas, which this installation lacks. Install: pip install pandas.") from None
    return pd.DataFrame(columns)


def parameter_columns(estimates: Estimates) -> dict[str, Any]:
    """Columns of a table with one row per quantity."""
    keys = estimates.parameters
    return {
        "kind": [key.kind for key in keys],
        "owner": [key.owner for key in keys],
        "id": [key.id for key in keys],
        "quantity": [key.quantity for key in keys],
        "value": estimates.values,
        "sigma": estimates.sigma0 * np.sqrt(estimates.cofactor.variances),
    }


def residual_columns(observations: Observations, residuals: Residuals) -> dict[str, Any]:
    """Columns of a table with one row per observation."""
    columns: dict[str, Any] = {"image": observations.image, "point": observations.point, "kind": observations.kind}
    pairs = {"{}_mm": observations.xy_mm, "v{}_um": 1e3 * residuals.v_mm, "redundancy_{}": residuals.redundancy}
    pairs["w_{}"] = residuals.w
    return columns | {name.format(axis): pair[:, k] for name, pair in pairs.items() for k, axis in enumerate("xy")}
