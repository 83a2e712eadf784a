"""One context for all tests, with the validation layer looking on."""

from typing import Iterator

import pytest
from nertca_vk import Context


@pytest.fixture(scope="session")
def context() -> Iterator[Context]:
    with Context(validation=True, deterministic=True) as made:
        yield made
        described = made.describe()
        assert described["validation_messages"] == []
        assert described["memory_in_use"] == 0, "device memory was not freed"
