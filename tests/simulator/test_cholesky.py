"""The block solver against a dense one."""

import numpy as np
import pytest
import scipy.sparse as sp

from jaxunshear.simulator.cholesky import factorise


def band(count: int, seed: int = 0) -> sp.csr_matrix:
    """Positive definite, with couplings up to 40 apart, shuffled."""
    generator = np.random.default_rng(seed)
    half = sp.random(count, count, density=0.1, rng=generator).tocoo()
    near = np.abs(half.row - half.col) < 40
    entries = half.data[near] - 0.5, (half.row[near], half.col[near])
    half = sp.csr_matrix(entries, shape=half.shape)
    order = generator.permutation(count)
    return (half @ half.T + 0.1 * sp.eye(count)).tocsr()[order][:, order]


@pytest.mark.parametrize("count", [1, 7, 64, 500])
def test_it_solves(count):
    matrix = band(count)
    right = np.random.default_rng(1).normal(size=(count, 3))
    expected = np.linalg.solve(matrix.toarray(), right)
    np.testing.assert_allclose(factorise(matrix)(right), expected, rtol=1e-8, atol=1e-9)


def test_parts_that_do_not_couple():
    matrix = sp.block_diag([band(100), band(90, 1)]).tocsr()
    right = np.ones((190, 1))
    np.testing.assert_allclose(matrix @ factorise(matrix)(right), right, atol=1e-9)


def test_a_matrix_that_is_not_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        factorise((band(200) - 10 * sp.eye(200)).tocsr())
