"""What tests of compiled forms need: a compiler. With one, a source that does not compile fails them."""

import os
import shlex
import shutil

import pytest

from jaxunshear.models.fast import compiled_kernels


@pytest.fixture
def compiled() -> None:
    """The compiled forms; skips where there is no C++ compiler."""
    compiler = (shlex.split(os.environ.get("CXX", "")) or ["c++"])[0]
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no C++ compiler {compiler}")
    assert compiled_kernels.is_available()
