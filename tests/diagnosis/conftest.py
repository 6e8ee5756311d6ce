"""Errors in cameras do not change the images: each set of images is matched once."""

import pytest

from lsmgeo.diagnosis import evidence
from lsmgeo.diagnosis.feature_matching import match_features


@pytest.fixture(scope="session")
def matches_by_paths():
    known = {}

    def match(scene, views):
        key = tuple(scene.paths)
        if key not in known:
            known[key] = match_features(scene, views)
        return known[key]

    return match


@pytest.fixture(autouse=True)
def same_matches(matches_by_paths, monkeypatch):
    monkeypatch.setattr(evidence, "match_features", matches_by_paths)
