"""What a report says in words."""

from dataclasses import replace

import pytest
from tests.report_example import report

from napari_mufasa.report.words import detectable_rows


@pytest.mark.parametrize(
    ("kind", "strength", "said"),
    [
        ("em_excess_noise", 2.11, "≥ 2.11 or ≤ 1.89"),  # more or less than the ideal register
        ("em_excess_noise", 1.04, "≥ 1.04"),  # in a camera believed a CCD
        ("baseline_drift", 3.0, "≥ 3 or ≤ -3 ADU"),
        ("stage_drift", 0.123, "≥ 0.123 px"),
        ("cosmic_rays", None, "not at any plausible strength"),
        ("of_another_package", 0.5, "strength ≥ 0.5"),
    ],
)
def test_what_would_have_been_seen_is_told_on_both_sides_of_nothing(kind, strength, said):
    ((found, (_, words), _),) = detectable_rows(replace(report(), detectable={kind: strength}))
    assert found == kind and words.endswith(said)
