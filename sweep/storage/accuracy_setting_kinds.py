"""Kinds of accuracy settings, as the stores of `sweep accuracy` hold them.

An accuracy setting is a choice of tolerance, effects, beamlets or draws. The thesis is D. B.
Chester, *A Parameterized Simulation of Doppler Lidar*, Utah State University, 2017.
"""

AS_WRITTEN_KIND = "as written"
"""Kind of the setting that computes the spec unchanged."""
ADAPTIVE_KIND = "adaptive"
"""Kind of settings that simulate an effect only where a tolerance requires it."""
ALL_EFFECTS_KIND = "all on"
"""Kind of settings with all effects at every point."""
FIXED_EFFECTS_KIND = "fixed effects"
"""Kind of settings with the same effects at every point."""
BEAMLET_LATTICE_KIND = "beamlets"
"""Kind of settings with a fixed number of beamlets in a lattice.

Beamlets are the rays that sample the cross-section of a beam.
"""
BEAMLET_ROW_KIND = "in a line"
"""Kind of settings with a fixed number of beamlets (rays that sample a beam) in a row."""
CLOSED_FORM_KIND = "closed form"
"""Kind of settings that compute the effects of Chester's thesis (2017) in closed form."""
THESIS_METHOD_KIND = "thesis"
"""Kind of settings that compute by the method of Chester's thesis (2017)."""
IMPROVED_THESIS_METHOD_KIND = "thesis improved"
"""Kind of settings that compute by an improved form of the method of Chester's thesis (2017)."""
REFERENCE_KIND = "reference"
"""Kind of the reference: the most accurate setting, with which all others are compared."""
MEAN_PD_OF_DRAWS_KIND = "means of draws"
"""Kind of settings that average pd (detection probability) over a fixed number of draws."""
COUNTED_DETECTIONS_KIND = "draws counted"
"""Kind of settings that count detections in a fixed number of draws."""
COUNTED_DETECTIONS_IN_NOISE_KIND = "draws in noise"
"""Kind of settings that count detections in a fixed number of draws with noise in every bin."""
