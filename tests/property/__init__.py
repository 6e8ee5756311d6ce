"""Laws of the operators, each for all scenes that Hypothesis draws, in float64 with a float32 twin.

Every file of laws also pins values against :mod:`tests.oracle`: the zero operator satisfies linearity and symmetry.
"""
