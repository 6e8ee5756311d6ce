"""The laws that faults are held against: the property suite's own tests, each on a few fixed examples."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from tests.property import (
    test_augmentation,
    test_correlation,
    test_frustum,
    test_gradients,
    test_grids_and_rays,
    test_hidden_sites,
    test_layout,
    test_linearity,
    test_pixel_depths,
    test_plane_sweep,
    test_points,
    test_ray_tracing,
    test_sample_volume,
    test_splat,
    test_symmetry,
    test_unproject,
    test_view_statistics,
)
from tests.property.support import DTYPES
from tests.strategies import rotations, scenes, vectors

DRAWN, USED = 40, 6


class Law(NamedTuple):
    """A test and the strategies of its arguments, or fixed arguments."""

    test: Callable[..., None]
    strategies: tuple[st.SearchStrategy[Any], ...] = ()
    fixed: tuple[tuple[Any, ...], ...] = ()

    @property
    def name(self) -> str:
        return self.test.__name__.removeprefix("test_").replace("_", " ")

    def examples(self) -> tuple[tuple[Any, ...], ...]:
        return _drawn(self.strategies) if self.strategies else self.fixed or ((),)

    def check(self) -> None:
        """Raise if the law does not hold."""
        law = getattr(self.test, "hypothesis", None)
        call = self.test if law is None else law.inner_test
        for example in self.examples():
            call(*example)


@functools.cache
def _drawn(strategies: tuple[st.SearchStrategy[Any], ...]) -> tuple[tuple[Any, ...], ...]:
    """The last few of Hypothesis's derandomised examples; the first ones are its simplest."""
    collected: list[tuple[Any, ...]] = []

    @settings(max_examples=DRAWN, derandomize=True, database=None, deadline=None, phases=[Phase.generate])
    @given(st.tuples(*strategies))
    def collect(example: tuple[Any, ...]) -> None:
        collected.append(example)

    collect()
    return tuple(collected[-USED:])


_SCENE = scenes()
_SWEEP = test_plane_sweep.sweeps()
_CLOSE = scenes(placements=("facing", "inside", "grazing"))
_FAR = scenes(placements=("facing", "grazing"))
_TURN, _SHIFT = rotations(), vectors()
_DTYPES = tuple((dtype,) for dtype in DTYPES)

# Laws that pin values come last, so that the table shows what the narrower ones notice.
LAWS = (
    Law(test_unproject.test_image_is_half_open_and_the_near_plane_is_not_in_front, fixed=_DTYPES),
    Law(test_unproject.test_nearest_takes_the_cell_that_contains_the_sample, fixed=_DTYPES),
    Law(test_unproject.test_feature_map_of_another_size_is_resized_for, fixed=_DTYPES),
    Law(test_augmentation.test_channels_come_depth_first_whatever_order_was_asked, fixed=((("direction", "depth"),),)),
    Law(test_augmentation.test_channels_are_defined_behind_and_outside),
    Law(test_augmentation.test_direction_at_the_centre_is_zero_with_zero_gradient, fixed=_DTYPES),
    Law(test_view_statistics.test_gradient_of_max_goes_to_the_first_visible_view),
    Law(test_view_statistics.test_statistics_of_three_numbers_are_known, fixed=_DTYPES),
    Law(test_gradients.test_derivative_at_an_integer_pixel_is_that_of_the_cell_floor, fixed=((DTYPES[0], "zeros"),)),
    Law(test_linearity.test_backward_is_the_adjoint, (_SCENE, test_linearity.MODES)),
    Law(test_hidden_sites.test_site_in_the_camera_centre_gives_zero_gradient, fixed=_DTYPES),
    Law(test_hidden_sites.test_behind_all_is_zero_and_so_are_all_gradients, (scenes(placements=("behind",)),)),
    Law(
        test_hidden_sites.test_views_that_see_nothing_read_nothing, (scenes(placements=("behind", "behind", "facing")),)
    ),
    Law(test_hidden_sites.test_masked_views_are_unread_and_unchecked, (_SCENE,)),
    Law(test_symmetry.test_slabs_are_the_whole, (_SCENE, test_unproject.OPTIONS, st.integers(1, 4))),
    Law(test_symmetry.test_moving_world_and_cameras_together_changes_nothing_but_ray_frames, (_SCENE, _TURN, _SHIFT)),
    Law(test_symmetry.test_views_are_independent_and_keep_their_order, (_SCENE, test_unproject.OPTIONS)),
    Law(test_symmetry.test_resizing_a_linear_image_changes_nothing_inside, (scenes(least=7), st.just((2, 3)))),
    Law(test_frustum.test_sites_are_backprojected_pixels, (_CLOSE, st.booleans())),
    Law(test_frustum.test_view_reads_its_own_pixels_on_its_own_frustum, (scenes(("facing", "inside"), least=7),)),
    Law(test_grids_and_rays.test_voxel_centres_and_matrices_are_the_oracles, (_SCENE,)),
    Law(test_grids_and_rays.test_rays_run_from_the_centre_through_the_pixels, (_SCENE,)),
    Law(
        test_grids_and_rays.test_depth_planes_are_evenly_spaced_in_their_measure,
        (st.integers(2, 9), st.floats(0.5, 2.0), st.floats(1.5, 3.0)),
    ),
    Law(test_grids_and_rays.test_along_ray_reductions_are_their_definitions, (st.integers(0, 99), st.booleans())),
    Law(test_augmentation.test_depth_is_camera_z, (_SCENE,)),
    Law(test_augmentation.test_direction_is_the_unit_vector_from_the_camera_centre, (_SCENE,)),
    Law(test_unproject.test_constant_stays_constant_where_all_taps_exist, (_SCENE,)),
    Law(test_unproject.test_ramp_reads_the_projected_pixel, (scenes(placements=("facing", "inside", "on_pixel")),)),
    Law(test_ray_tracing.test_ray_traced_image_unprojects_to_the_texture_of_the_surface, (test_ray_tracing.shots(),)),
    Law(
        test_ray_tracing.test_swept_fields_are_read_at_the_analytic_ray_points,
        (test_ray_tracing.shots(), _TURN, _SHIFT),
    ),
    Law(test_plane_sweep.test_constant_is_kept_inside_and_lost_outside, (_SWEEP,)),
    Law(test_plane_sweep.test_linear_field_is_read_at_the_swept_point, (_SWEEP, _SHIFT)),
    Law(test_plane_sweep.test_flattened_channel_is_c_times_planes_plus_k, (_SWEEP,)),
    Law(
        test_plane_sweep.test_sweep_is_the_oracle,
        (
            _SWEEP,
            st.sampled_from(("trilinear", "nearest")),
            st.sampled_from(("zeros", "border")),
            st.sampled_from(((), ("direction", "depth"))),
            st.sampled_from(("world", "camera")),
            st.booleans(),
        ),
    ),
    Law(test_splat.test_the_nearest_is_an_indexed_sum_of_the_outer_product, fixed=(("reference", DTYPES[1]),)),
    Law(test_splat.test_masked_views_and_planes_behind_are_unread, fixed=(("reference", "border"),)),
    Law(test_splat.test_gradients, fixed=((True, False),)),
    Law(
        test_splat.test_splat_is_the_oracle,
        (_SWEEP, st.fixed_dictionaries(test_splat.MODES), st.just(True), st.booleans(), st.just(False)),
    ),
    Law(test_points.test_sample_views_is_unproject_after_projection, (_SCENE, test_points.MODES)),
    Law(test_sample_volume.test_planes_are_known, fixed=_DTYPES),
    Law(test_sample_volume.test_voxels_are_known, fixed=_DTYPES),
    Law(test_sample_volume.test_gradients_on_a_frustum, fixed=(("zeros",),)),
    Law(test_sample_volume.test_voxels_are_read_as_the_oracle_reads_them, (_SCENE, test_sample_volume.MODES)),
    Law(
        test_sample_volume.test_frustums_are_read_as_the_oracle_reads_them,
        (_CLOSE, test_sample_volume.MODES, st.sampled_from((1, 2, 5)), st.booleans()),
    ),
    Law(test_unproject.test_unproject_is_the_oracle, (_SCENE, test_unproject.OPTIONS)),
    Law(test_unproject.test_unproject_with_dropped_views_is_the_oracle, (_SCENE, test_unproject.OPTIONS)),
    Law(
        test_view_statistics.test_statistics_are_the_oracles_after_augmentation,
        (_SCENE, st.just(("variance", "max", "mean")), test_view_statistics.CALLS, st.just(False)),
    ),
    Law(
        test_correlation.test_hidden_sites_do_not_read_the_reference, fixed=((None, "reference"), ("mean", "reference"))
    ),
    Law(test_correlation.test_known_numbers, fixed=(("reference",),)),
    Law(test_correlation.test_gradients, fixed=((None, 1), ("mean", 4))),
    Law(test_pixel_depths.test_unproject_by_the_oracle, (_FAR, st.just(("depth", "direction")), st.just(False))),
    Law(test_pixel_depths.test_sweep_by_the_oracle, (_FAR, st.just(()))),
    Law(test_pixel_depths.test_gradients_to_the_depths_of_pixels),
    Law(test_gradients.test_gradients_to_every_input, fixed=((0, "grid"), (0, "sweep"))),
    Law(test_layout.test_one_pixel_one_voxel_one_plane, fixed=_DTYPES),
)
