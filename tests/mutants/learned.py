"""Mutants of the learned methods."""

from tests.mutants.mutant import mutant

_NTD, _NTASD, _OBJECTIVES = "jaxdn/methods/ntd.py", "jaxdn/methods/ntasd.py", "jaxdn/recipes/objectives.py"
_OF_ADAPTIVE = "tests/methods/test_adaptive.py::"
_OF_NTD = "tests/methods/test_ntd.py::"
_OF_OBJECTIVES = "tests/recipes/test_objectives.py::"

_OF_PAPERS = "tests/docs/test_papers.py::"

_PUBLISHED = (
    mutant(
        f"{name} in no preset of a paper",
        _NTD,
        f'    "{name}": "{value}",\n',
        "",
        _OF_PAPERS + "test_a_fact_is_that_of_the_code",
    )
    for name, value in (("kernels", "plain"), ("exposure", "given"), ("initialization", "xavier"))
)
LEARNED = (
    *_PUBLISHED,
    mutant(
        "the threshold of the occlusion mask is another",
        "jaxdn/ops/motion.py",
        "threshold: float = 0.5",
        "threshold: float = 1.0",
        _OF_PAPERS + "test_a_fact_is_that_of_the_code",
    ),
    mutant(
        "ntd and ntasd: the history is fetched along the opposite vector",
        _NTD,
        "        history = warp(history, vectors, border=options.border)\n",
        "        history = warp(history, -vectors, border=options.border)\n",
        _OF_NTD + "test_the_history_lies_where_the_vector_points",
    ),
    mutant(
        "ntd: alpha weighs the history",
        "jaxdn/methods/reconstruction.py",
        "return current * composed + (1.0 - current) * past[0]",
        "return (1.0 - current) * composed + current * past[0]",
        _OF_NTD + "test_alpha_weighs_the_current_frame_and_missing_history_is_not_used",
    ),
    mutant(
        "ntasd: the sampler does not see the last image",
        _NTASD,
        "            gray(color.compress(gain * past)),\n",
        "            0.0 * gray(color.compress(gain * past)),\n",
        _OF_ADAPTIVE + "test_the_sampler_of_ntasd_sees_the_last_image_along_the_vectors",
    ),
    mutant(
        "ntasd: heads of another layout in the preset",
        _NTASD,
        'PAPER = Options(alpha_at="coarse",',
        'PAPER = Options(alpha_at="fine",',
        _OF_ADAPTIVE + "test_of_the_paper_the_heads_are_51_26_and_26_channels",
    ),
    mutant(
        "ntasd and dasr: the sampler begins with other weights",
        "jaxdn/methods/sampler.py",
        "network = unet(groups, (1,), widths=widths, initialization=initialization,",
        'network = unet(groups, (1,), widths=widths, initialization="he",',
        _OF_ADAPTIVE + "test_of_the_paper_every_network_begins_as_glorot_and_bengio_say",
    ),
    mutant(
        "ntasd: pixels without samples have no gradient",
        _NTD,
        "jnp.where(sampled, 0.0, own)",
        "jnp.where(sampled, 0.0, 0.0 * own)",
        _OF_ADAPTIVE + "test_pixels_without_samples_learn_what_a_sample_would_bring",
    ),
    mutant(
        "dasr: the first sample is outside the budget",
        "jaxdn/methods/dasr.py",
        "allocate=allocate_after_first,",
        "allocate=allocate_samples,",
        _OF_ADAPTIVE + "test_the_first_sample_of_dasr_is_in_its_image_and_in_its_budget",
    ),
    mutant(
        "last_frames: no term of time",
        _OBJECTIVES,
        "return losses.spatial(denoised[-1:], wanted[-1:]) + losses.temporal(denoised, wanted)",
        "return losses.spatial(denoised[-1:], wanted[-1:])",
        _OF_OBJECTIVES + "test_the_last_frames_cost_their_error_and_that_of_their_change",
    ),
    mutant(
        "last_frames: the reference is not looked at",
        _OBJECTIVES,
        "denoised, wanted = color.compress(images[-2:]), color.compress(clip.reference[-2:])",
        "denoised, wanted = color.compress(images[-2:]), 0.0 * color.compress(clip.reference[-2:])",
        _OF_OBJECTIVES + "test_the_last_frames_cost_their_error_and_that_of_their_change",
    ),
    mutant(
        "compressed_illumination: linear radiance",
        _OBJECTIVES,
        "return losses.spatial(color.compress(images), color.compress(clip.reference))",
        "return losses.spatial(images, clip.reference)",
        _OF_OBJECTIVES + "test_single_frames_cost_their_compressed_error",
    ),
)
