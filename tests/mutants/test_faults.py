"""Every fault is noticed by a law, and no law fails without a fault."""

from __future__ import annotations

import pytest

from tests.mutants.__main__ import notices
from tests.mutants.faults import FAULTS
from tests.mutants.laws import LAWS


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.test.__name__)
def test_laws_hold_without_a_fault(law):
    law.check()


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_noticed(name, record_property):
    found = notices(name)
    record_property("noticed_by", found)
    assert found, f"no law notices: {name}"


def test_faults_are_undone():
    """After each fault the library is what it was."""
    for name in FAULTS:
        with FAULTS[name]():
            pass
    for law in LAWS[:8]:
        law.check()


def test_there_are_enough_faults():
    assert len(FAULTS) >= 33
