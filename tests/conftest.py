# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several test modules share."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data():
    """Folder with the real recordings and meshes that lies beside the repository, not in it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not on this machine: no folder {folder}")
    return folder
