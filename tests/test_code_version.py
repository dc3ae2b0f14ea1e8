"""The code of a result is that of the package's own checkout, read once."""

import os
import shutil
import subprocess
import sys

import pytest

from jaxunshear import __version__, code_version


def git(folder, *words):
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "init.defaultBranch=main")
    done = subprocess.run(
        ["git", *who, *words], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path):
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    folder = tmp_path / "checkout"
    (folder / "jaxunshear").mkdir(parents=True)
    (folder / "jaxunshear" / "a.py").write_text("a = 1\n")
    (folder / "README.md").write_text("words\n")
    git(folder, "init", "-q")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "first")
    return folder


def test_a_commit_and_whether_the_code_is_as_committed(checkout):
    commit = git(checkout, "rev-parse", "HEAD")
    (checkout / "README.md").write_text("other words\n")  # decides no result
    assert code_version.read_commit(checkout) == (commit, True)
    (checkout / "jaxunshear" / "b.py").write_text("b = 1\n")
    assert code_version.read_commit(checkout) == (commit, False)


def test_neither_the_working_directory_nor_a_hook_of_another_repository_counts(
    checkout, tmp_path, monkeypatch
):
    commit, other = git(checkout, "rev-parse", "HEAD"), tmp_path / "other"
    shutil.copytree(checkout, other)
    git(other, "commit", "-q", "--allow-empty", "-m", "second")
    monkeypatch.chdir(other)
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    assert code_version.read_commit(checkout)[0] == commit


def test_an_environment_inside_a_checkout_is_not_the_checkout(checkout):
    packages = checkout / ".venv" / "site-packages"
    packages.mkdir(parents=True)
    assert code_version.read_commit(packages) == (None, None)


@pytest.mark.parametrize("fault", ["no git", "no commit", "broken"])
def test_without_git_there_is_no_commit_and_nothing_is_printed(checkout, monkeypatch, capfd, fault):
    if fault == "no git":
        monkeypatch.setenv("PATH", str(checkout))
    elif fault == "no commit":
        shutil.rmtree(checkout / ".git")
        git(checkout, "init", "-q")
    else:
        (checkout / ".git" / "HEAD").write_text("nothing")
    assert code_version.read_commit(checkout) == (None, None)
    assert capfd.readouterr() == ("", "")


def test_an_installed_package_has_its_version_alone(tmp_path):
    """Also if it is started in a checkout."""
    ours, copy = code_version.ROOT / "jaxunshear", tmp_path / "jaxunshear"
    shutil.copytree(ours / "results", copy / "results")
    for name in ("__init__.py", "version.py", "code_version.py"):
        shutil.copy(ours / name, copy)
    asked = (
        "from jaxunshear.code_version import read_source as read; "
        "print(read().version, read().commit, read().clean)"
    )
    words, here = [sys.executable, "-P", "-c", asked], os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        words, env=here, cwd=code_version.ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [__version__, "None", "None"]
