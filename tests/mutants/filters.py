"""Mutants of the filters, method by method."""

from tests.mutants.mutant import Edit, Mutant, mutant

_CASCADE, _GRADIENTS = "jaxdn/filters/cascade.py", "jaxdn/filters/gradients.py"
_ACCUMULATION, _VARIANCE = "jaxdn/filters/accumulation.py", "jaxdn/filters/variance.py"
_HISTORIES, _LOBES = "jaxdn/methods/two_lobes/histories.py", "jaxdn/methods/lobes.py"
_RELAX, _REBLUR = "jaxdn/methods/two_lobes/relax.py", "jaxdn/methods/two_lobes/reblur.py"
_TRMV = "jaxdn/methods/trmv.py"

_OF_SVGF = "tests/methods/test_svgf.py::test_four_frames_match_the_reference"
_OF_ASVGF = "tests/methods/test_asvgf.py::"
_OF_RELAX, _OF_REBLUR = "tests/methods/test_relax.py::", "tests/methods/test_reblur.py::"
_OF_BOTH = "tests/methods/test_histories.py::"
_OF_TRMV = "tests/methods/test_trmv.py::"
_FURNACE = "tests/methods/test_white_furnace.py::"

SVGF = (
    mutant(
        "svgf: the variance is not blurred",
        _CASCADE,
        "blur_variance(tiles.crop(variance))",
        "tiles.crop(variance)",
        _OF_SVGF,
    ),
    mutant(
        "svgf: weights of the variance are not squared",
        "jaxdn/filters/stencil_tiles.py",
        "squares = squares + weight * weight * tiles",
        "squares = squares + weight * tiles",
        _OF_SVGF,
    ),
    mutant(
        "svgf: the variance over time is the second moment",
        _VARIANCE,
        "variance = jnp.maximum(moments[1] - moments[0] ** 2, 0.0)",
        "variance = jnp.maximum(moments[1], 0.0)",
        _OF_SVGF,
    ),
    mutant(
        "svgf: what comes back is the image after the second level",
        _CASCADE,
        "jnp.where(level + 1 == feedback_level,",
        "jnp.where(level == feedback_level,",
        _OF_SVGF,
    ),
    mutant(
        "svgf: the history keeps the texture that it had",
        _ACCUMULATION,
        "colour = brdf.restore(history[:3], after, before)",
        "colour = history[:3]",
        _FURNACE + "test_a_reflectance_that_changes_darkens_nothing[svgf-lighter-matt]",
    ),
)

ASVGF = (
    mutant(
        "asvgf: the change loses its sign before it is filtered",
        _GRADIENTS,
        "jnp.stack([change.delta, change.size]), change.delta**2",
        "jnp.stack([absolute(change.delta), change.size]), change.delta**2",
        _OF_ASVGF + "test_the_reconstruction_matches_a_loop",
    ),
    mutant(
        "asvgf: moments are not given up",
        _ACCUMULATION,
        "share_moments = share_moments + change * (1.0 - share_moments)",
        "share_moments = share_moments + 0.0 * change",
        _OF_ASVGF + "test_blending_by_the_share_that_changed_matches_the_formula",
    ),
    mutant(
        "asvgf: the option antilag does nothing",
        "jaxdn/methods/asvgf.py",
        "** options.antilag",
        "** 1.0",
        _OF_ASVGF + "test_light_that_doubles_is_followed_at_once",
    ),
    mutant(
        "asvgf: of reflected light only the indirect part is replayed",
        "jaxdn/render/buffers/gradient_samples.py",
        '"with_direct": with_direct}',
        '"with_direct": False}',
        "tests/render/test_gradient_samples.py::test_of_reflected_light_the_direct_part_is_replayed_too",
    ),
)

RELAX = (
    mutant(
        "relax: the slow history is not clamped to the fast one",
        _HISTORIES,
        "held = clamp_to_fast(fixed, fast, signal.hit, sigma=options.clamp_sigma)",
        "held = fixed",
        _OF_RELAX + "test_a_slow_history_is_held_to_the_fast_one_and_keeps_its_variance",
    ),
    mutant(
        "relax: an outdated history is not found",
        _HISTORIES,
        "lag = detect_lag(level, luminance(fast), signal.hit, sigma=options.lag_sigma, radius=_AROUND)",
        "lag = 0.0 * level",
        _OF_RELAX + "test_light_that_doubles_arrives_within_the_slow_historys_length",
    ),
    mutant(
        "relax: a history that begins is not filled",
        _HISTORIES,
        "    if signal.diffuseness is not None:\n        fixed = new",
        "    fixed = new\n    if signal.diffuseness is not None:\n        fixed = new",
        _OF_RELAX + "test_a_history_that_begins_is_filled_from_around",
    ),
    mutant(
        "relax: no a-trous levels",
        _RELAX,
        "    return jnp.concatenate(kept), image\n",
        "    return jnp.concatenate(kept), calm\n",
        _OF_RELAX + "test_both_kinds_of_light_have_their_own_tolerance_of_differences",
    ),
    mutant(
        "relax: moments do not follow what was clamped",
        _RELAX,
        "moments = after_shift(slow[3:5], shift)",
        "moments = slow[3:5] + 0.0 * shift",
        _OF_RELAX + "test_a_slow_history_is_held_to_the_fast_one_and_keeps_its_variance",
    ),
    mutant(
        "relax: reflections have the tolerance of diffuse light",
        _RELAX,
        "sigma = options.sigma_diffuse if signal.diffuseness is None else options.sigma_specular",
        "sigma = options.sigma_diffuse",
        _OF_RELAX + "test_both_kinds_of_light_have_their_own_tolerance_of_differences",
    ),
    mutant(
        "relax: the filtered image comes back",
        _RELAX,
        "    return jnp.concatenate(kept), image\n",
        "    return jnp.concatenate(kept).at[:3].set(image), image\n",
        _OF_RELAX + "test_nothing_that_was_filtered_in_space_comes_back",
    ),
    mutant(
        "lobes: a reflection is not tested for closeness",
        _LOBES,
        "alike = alike & (jnp.abs(virtual[-2] - near) < _ALIKE_CLOSENESS) & found.valid[..., 0]",
        "alike = alike & found.valid[..., 0]",
        _OF_RELAX + "test_a_reflection_that_is_another_has_no_history",
    ),
    mutant(
        "lobes: specular light is divided by what else is reflected",
        _LOBES,
        "below = None if rest is None else brdf.divisor(rest), brdf.divisor(known)",
        "below = None if rest is None else brdf.divisor(rest), brdf.divisor(known if rest is None else rest)",
        _OF_RELAX + "test_colours_of_a_texture_do_not_run[2]",
    ),
    mutant(
        "lobes: specular light has the weights of diffuse light",
        _HISTORIES,
        "    return diffuse, specular\n\n\ndef update_fast_mean",
        "    return diffuse, diffuse\n\n\ndef update_fast_mean",
        _OF_BOTH + "test_specular_light_is_not_mixed_with_that_of_another_roughness",
    ),
)

REBLUR = (
    mutant(
        "reblur: discs do not shrink",
        _REBLUR,
        "jnp.maximum(options.radius * far / jnp.sqrt(length), options.radius_min * wide)",
        "options.radius * far",
        _OF_REBLUR + "test_two_discs_shrink_as_the_root_of_the_number_of_frames",
    ),
    mutant(
        "reblur: no second disc",
        _REBLUR,
        "held = blur(blur(held, radius, 1), 2.0 * radius, 2)",
        "held = blur(held, radius, 1)",
        _OF_REBLUR + "test_two_discs_shrink_as_the_root_of_the_number_of_frames",
    ),
    Mutant(
        "reblur: the history is not the blurred image",
        (
            Edit(_REBLUR, "    if options.radius:\n", "    unblurred = held\n    if options.radius:\n"),
            Edit(_REBLUR, "for light in (held, fast)]", "for light in (unblurred, fast)]"),
        ),
        (_OF_REBLUR + "test_the_history_is_the_blurred_image",),
    ),
    mutant(
        "reblur: no blur before the accumulation",
        _REBLUR,
        "    if options.pre_radius:\n",
        "    if False:\n",
        _OF_REBLUR + "test_four_taps_blur_the_frame_before_it_is_accumulated",
    ),
    mutant(
        "reblur: luminance is not steadied",
        _REBLUR,
        "1.0 - 1.0 / stable_length,",
        "0.0 / stable_length,",
        _OF_REBLUR + "test_a_luminance_is_steadied_by_what_the_image_shows_around_it",
    ),
    mutant(
        "reblur: discs turn with nothing",
        _REBLUR,
        "6 * number + (3 if signal.diffuseness is None else 0) + turn",
        "0",
        _OF_REBLUR + "test_discs_turn_with_the_frame_the_disc_and_the_kind_of_light",
    ),
    mutant(
        "reblur: discs do not turn with the frame",
        _REBLUR,
        "6 * number + (3",
        "0 * number + (3",
        _OF_REBLUR + "test_discs_turn_with_the_frame_the_disc_and_the_kind_of_light",
    ),
    mutant(
        "reblur: hit distances do not stop the blur",
        _REBLUR,
        "    if signal.diffuseness is not None and near is not None:\n",
        "    if False:\n",
        _OF_REBLUR + "test_what_is_reflected_from_far_is_not_mixed_with_what_is_near",
    ),
)

TRMV = (
    mutant(
        "trmv: a shadow brings the light of where it was",
        _TRMV,
        "_share(found[:3], found[3:6]) * found[6:9]",
        "found[:3]",
        _OF_TRMV + "test_a_shadow_brings_its_share_and_no_light_of_where_it_was",
    ),
    mutant(
        "trmv: other light follows the vectors of surfaces",
        _TRMV,
        "along = frame.motion if frame.dual_motion is None else frame.dual_motion",
        "along = frame.motion",
        _OF_TRMV + "test_other_light_is_fetched_along_the_dual_vectors",
    ),
    mutant(
        "trmv: reflections follow the dual vectors",
        _TRMV,
        "along = frame.motion if frame.glossy_motion is None else frame.glossy_motion",
        "along = frame.motion if frame.dual_motion is None else frame.dual_motion",
        _OF_TRMV + "test_a_reflection_is_fetched_where_it_was",
    ),
    mutant(
        "trmv: shares of shadows are not clamped",
        _TRMV,
        "held = _clamp_shadows(options, past, parts.shadowed, parts.unshadowed, hit)",
        "held = past[:9]",
        _OF_TRMV + "test_the_share_of_a_shadow_is_held_to_what_the_frame_shows",
    ),
    mutant(
        "trmv: filtered specular light comes back",
        _TRMV,
        "            specular = history.transpose(1, 2, 0)\n",
        "            specular = history.at[:3].set(\n"
        "                _filter_specular(options, today, texture, frame, hit, statistics.height)\n"
        "            ).transpose(1, 2, 0)\n",
        _OF_TRMV + "test_nothing_that_was_filtered_in_space_comes_back",
    ),
    mutant(
        "trmv: colours do not stop reflections",
        _TRMV,
        "[*_lobe_weights(options, frame, height, level), *hues]",
        "[*_lobe_weights(options, frame, height, level), *hues[:0]]",
        _OF_TRMV + "test_reflections_of_another_colour_are_not_mixed",
    ),
)

OTHERS = (
    mutant(
        "taa: each channel is clamped where the colour has to be clipped",
        "jaxdn/filters/neighbourhood.py",
        "return center + offset / jnp.maximum(excess, 1.0)",
        "return center + jnp.clip(offset, -jnp.maximum(size, smallest), jnp.maximum(size, smallest)) + 0.0 * excess",
        "tests/methods/test_taa.py::test_a_clipped_colour_lies_in_the_box_and_towards_its_centre",
    ),
    mutant(
        "brdf: the axes of the table are exchanged",
        "jaxdn/brdf.py",
        "for value in (cosine, roughness))",
        "for value in (roughness, cosine))",
        "tests/materials/test_brdf.py::test_the_table_has_the_known_values",
    ),
    mutant(
        "brdf: light is divided by the albedo where the reflectance is there",
        "jaxdn/methods/demodulation.py",
        "    return frame.albedo if frame.reflectance is None else frame.reflectance\n",
        "    return frame.reflectance if frame.albedo is None else frame.albedo\n",
        _FURNACE + "test_a_reflectance_that_changes_darkens_nothing[svgf-lighter-matt]",
    ),
)

FILTERS = (*SVGF, *ASVGF, *RELAX, *REBLUR, *TRMV, *OTHERS)
