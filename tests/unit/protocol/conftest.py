import importlib.util
import sys

import pytest
from hypothesis import settings

from tests.paths import GOLDEN

settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, max_examples=100)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def golden():
    """The script that makes the golden files, as a module."""
    spec = importlib.util.spec_from_file_location("golden_make", GOLDEN / "make.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["golden_make"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module
