"""The interval of a parameter that images leave open is that of its prior."""

import numpy as np
import pytest

from jaxunshear.calibration.fit import MAX_INTERVAL_SHARE, PRIOR_PX, _bootstrap, _Minimum

PRIOR = np.array([0.3, 2.0])  # standard deviations


@pytest.mark.parametrize(
    ("slope", "determined"), [(0.0, False), (1e-3, False), (0.02, False), (10.0, True)]
)
@pytest.mark.parametrize("noise", [0.15, 0.3])
def test_a_parameter_that_the_images_do_not_give_is_as_wide_as_its_prior(slope, determined, noise):
    generator = np.random.default_rng(1)
    residual = noise * generator.normal(size=(100, 5)) / np.sqrt(5)
    slopes = np.zeros((100, 5, 2))
    slopes[:, 1:, 0], slopes[:, 0, 1] = 1.0, slope * PRIOR_PX / PRIOR[1]
    minima = _bootstrap(_Minimum(np.zeros(2), residual, slopes), np.ones(100), PRIOR)
    width = np.ptp(np.percentile(minima, [2.5, 97.5], axis=0), axis=0) / (2 * 1.96 * PRIOR)
    assert width[0] < MAX_INTERVAL_SHARE / 4
    assert (width[1] < MAX_INTERVAL_SHARE) == determined
    if slope < 0.01:
        assert width[1] == pytest.approx(1, abs=0.15)
