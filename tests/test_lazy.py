"""Packages re-export at run time the names that their type checkers see."""

import qs3


def test_names_that_are_not_loaded_yet_are_listed():
    named = {"load", "scan", "adapt", "Classifier", "load_mesh", "load_sensor", "shapes"}
    assert named <= {*dir(qs3)}
