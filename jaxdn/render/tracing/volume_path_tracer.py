"""The path tracer for homogeneous media that scatter light (fog, smoke), for Mitsuba's vectorised variants.

A ray in a medium is scattered at a random distance, or meets a surface first. A path's vertices are both: each samples
a light and a direction, by the phase function or the BSDF, which the balance heuristic combines (Veach 1997, sec. 9.2;
Novák et al. 2018, sec. 5). For coloured extinction the distance is drawn for one of the three colours, and weighted by
the mean of the three densities. The bounds of a medium (surfaces whose BSDF is ``null``) are no vertices: rays pass
them, those towards lights too. Light that is scattered once, by a surface or by the medium, is direct.
"""

import random
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from jaxdn.render.scenes.media import absorbs, find_medium_behind, list_media
from jaxdn.render.tracing.lobes import draw_bounce_numbers

_CROSSINGS = 32
"""Bounds of media that a path may pass besides its vertices, and a ray towards a light."""


def scatters(scene: Any) -> bool:
    """Whether a loaded scene has a medium that scatters light."""
    return any(not absorbs(medium) for _, medium in list_media(scene))


def is_bound(bsdf: Any, active: Any) -> Any:
    """Whether surfaces are nothing but the bounds of a medium: rays pass them straight, whatever their length is."""
    flags = bsdf.flags()
    more = mi.has_flag(flags, mi.BSDFFlags.Smooth) | mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    more |= mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
    # Not `~more`: without vectors it is Python's bool, whose inversion Python 3.16 no longer has.
    return active & mi.has_flag(flags, mi.BSDFFlags.Null) & (more ^ True)


def sample_distance(medium: Any, ray: Any, hit: Any, numbers: Any, active: Any) -> tuple[Any, Any, Any]:
    """Sample where rays are scattered: interactions with media, whether they come before ``hit``, and the weight.

    Two random numbers a lane. The weight is 1 where there is no medium.
    """
    color, share = numbers.next_float32(), numbers.next_float32()
    channel = dr.minimum(mi.UInt32(color * 3), 2)
    inside = active & (medium != None)  # noqa: E711  (an array of pointers compares elementwise)
    event = medium.sample_interaction(ray, share, channel, inside)
    scattered = inside & (event.t < hit.t)
    length = dr.minimum(dr.select(scattered, event.t, hit.t), dr.largest(mi.Float))
    left = dr.exp(-event.sigma_t * length)
    density = dr.mean(dr.select(scattered, event.sigma_t * left, left))
    weight = dr.select(scattered, event.sigma_s * left, left) / density
    weight = dr.select(inside & (density > 0), weight, dr.select(inside, mi.Spectrum(0.0), mi.Spectrum(1.0)))
    return event, scattered, weight


@dr.syntax
def compute_visibility(scene: Any, ray: Any, goal: Any, medium: Any, active: Any) -> Any:
    """The share of light that arrives along rays from ``goal``: 0 behind a surface, less than 1 through media."""
    seen = mi.Spectrum(1.0)
    ray = mi.Ray3f(ray)
    medium = mi.MediumPtr(medium)
    crossed: Any = mi.UInt32(0)
    running: Any = mi.Bool(active)
    while running:
        hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=False, active=running)
        there = running & hit.is_valid()
        passes = is_bound(hit.bsdf(), there)
        length = dr.minimum(dr.select(there, hit.t, ray.maxt), dr.largest(mi.Float))
        inside = running & (medium != None)  # noqa: E711
        point = dr.zeros(mi.MediumInteraction3f, dr.width(length))
        extinction = medium.get_scattering_coefficients(point, inside)[2]
        seen *= dr.select(inside, dr.exp(-extinction * length), mi.Spectrum(1.0))
        seen = dr.select(there & ~passes, mi.Spectrum(0.0), seen)
        medium = dr.select(passes, hit.target_medium(ray.d), medium)
        ray = mi.Ray3f(dr.select(passes, hit.spawn_ray_to(goal), ray))
        crossed += 1
        running &= passes & (crossed < _CROSSINGS)
    return dr.select(active, seen, mi.Spectrum(0.0))


@dr.syntax
def trace_in_media(scene: Any, ray: Any, numbers: Any, max_depth: Any) -> tuple[Any, Any, Any]:
    """Follow one path per lane, as :func:`jaxdn.render.tracing.vectorised_path_tracer.trace` does, through media."""
    context, phases = mi.BSDFContext(), mi.PhaseFunctionContext(None)
    medium = mi.MediumPtr(scene.sensors()[0].get_medium())
    emitted, direct, indirect = mi.Spectrum(0.0), mi.Spectrum(0.0), mi.Spectrum(0.0)
    throughput = mi.Spectrum(1.0)
    depth: Any = mi.UInt32(0)
    steps: Any = mi.UInt32(0)
    ray = mi.Ray3f(ray)
    last = dr.zeros(mi.Interaction3f)
    last_pdf = mi.Float(1.0)
    last_delta: Any = mi.Bool(True)
    active: Any = mi.Bool(True)
    while active:
        hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=depth == 0, active=active)
        event, scattered, weight = sample_distance(medium, ray, hit, numbers, active)
        throughput *= dr.select(active, weight, mi.Spectrum(1.0))
        there = active & ~scattered

        # The sampled direction found an emitter: weigh it against having sampled that emitter directly.
        found: Any = mi.DirectionSample3f(scene, hit, last)
        shines = there & (found.emitter != None)  # noqa: E711
        emitter_pdf = scene.pdf_emitter_direction(last, found, shines & ~last_delta)
        share = dr.select(last_pdf > 0, last_pdf / (last_pdf + emitter_pdf), 0.0)
        light = dr.select(shines, throughput * share * found.emitter.eval(hit, shines), 0.0)
        emitted += dr.select(depth == 0, light, 0.0)
        direct += dr.select(depth == 1, light, 0.0)
        indirect += dr.select(depth >= 2, light, 0.0)

        bsdf = hit.bsdf(ray)
        passes = is_bound(bsdf, there & hit.is_valid())
        surface = there & hit.is_valid() & ~passes & (depth + 1 < max_depth)
        volume = scattered & (depth + 1 < max_depth)
        vertex = surface | volume

        # Sample an emitter, and draw the numbers of this bounce whether or not they are used.
        place = dr.zeros(mi.Interaction3f, dr.width(hit.t))
        place.p = dr.select(scattered, event.p, hit.p)
        place.n = dr.select(scattered, mi.Normal3f(0.0), hit.n)
        pick, lobe, point = draw_bounce_numbers(numbers)
        smooth = volume | (surface & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
        towards, radiance = scene.sample_emitter_direction(place, pick, False, smooth)
        smooth &= towards.pdf != 0.0
        reflected, bsdf_pdf, sampled, bsdf_weight = bsdf.eval_pdf_sample(
            context, hit, hit.to_local(towards.d), lobe, point, surface
        )
        phase = event.medium.phase_function()
        forward, phase_pdf = phase.eval_pdf(phases, event, towards.d, volume)
        onward, phase_weight, onward_pdf = phase.sample(phases, event, lobe, point, volume)
        response = dr.select(scattered, forward, reflected)
        own_pdf = dr.select(scattered, phase_pdf, bsdf_pdf)
        share = dr.select(towards.delta, 1.0, towards.pdf / (towards.pdf + own_pdf))
        behind = dr.select(scattered, medium, find_medium_behind(hit, medium, towards.d))
        light = dr.select(smooth, throughput * response * radiance * share, 0.0)
        lit = smooth & (dr.max(light) > 0)
        light *= compute_visibility(scene, place.spawn_ray_to(towards.p), towards.p, behind, lit)
        light = dr.select(lit, light, 0.0)
        direct += dr.select(depth == 0, light, 0.0)
        indirect += dr.select(depth >= 1, light, 0.0)

        # Go on from a vertex, or straight through a bound.
        throughput *= dr.select(volume, mi.Spectrum(phase_weight), dr.select(surface, bsdf_weight, mi.Spectrum(1.0)))
        direction = dr.select(scattered, onward, dr.select(surface, hit.to_world(sampled.wo), ray.d))
        medium = dr.select(scattered, medium, find_medium_behind(hit, medium, direction))
        ray = place.spawn_ray(direction)
        last = dr.select(vertex, place, last)
        last_pdf = dr.select(volume, onward_pdf, dr.select(surface, sampled.pdf, last_pdf))
        delta = surface & mi.has_flag(sampled.sampled_type, mi.BSDFFlags.Delta)
        last_delta = dr.select(vertex, delta, last_delta)
        depth += dr.select(vertex, mi.UInt32(1), mi.UInt32(0))
        steps += 1
        active &= (vertex | passes) & (dr.max(throughput) != 0) & (steps < max_depth + _CROSSINGS)
    return emitted, direct, indirect


@dr.syntax
def find_first_vertex(scene: Any, ray: Any, numbers: Any) -> tuple[Any, Any, Any]:
    """Find where the paths of camera rays begin; ``numbers`` is the generator that the paths begin with.

    Returns the rays behind the bounds of media that they pass, whether a medium scatters them before they meet a
    surface, and the albedo of that medium.
    """
    medium = mi.MediumPtr(scene.sensors()[0].get_medium())
    ray = mi.Ray3f(ray)
    albedo = mi.Spectrum(0.0)
    scattered: Any = mi.Bool(False)
    crossed: Any = mi.UInt32(0)
    running: Any = mi.Bool(True)
    while running:
        hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True, active=running)
        event, here, _ = sample_distance(medium, ray, hit, numbers, running)
        draw_bounce_numbers(numbers)  # those that the path takes at a bound, too
        passes = is_bound(hit.bsdf(), running & ~here & hit.is_valid())
        albedo = dr.select(here, event.sigma_s / event.sigma_t, albedo)
        scattered |= here
        medium = dr.select(passes, hit.target_medium(ray.d), medium)
        ray = mi.Ray3f(dr.select(passes, hit.spawn_ray(ray.d), ray))
        crossed += 1
        running &= passes & (crossed < _CROSSINGS)
    return ray, scattered, albedo


def find_one_first_vertex(scene: Any, ray: Any, seed: int) -> tuple[Any, Any, np.ndarray | None]:
    """The ray, its first hit, and the albedo of the medium that scatters it before that, or None.

    For the variant without vectorisation; the random numbers are not those of its integrators.
    """
    numbers, medium = random.Random(seed), scene.sensors()[0].get_medium()
    for _ in range(_CROSSINGS):
        hit = scene.ray_intersect(ray)
        if medium is not None:
            sigma_s, _, sigma_t = (
                np.ravel(np.array(each, np.float64))
                for each in medium.get_scattering_coefficients(mi.MediumInteraction3f(), True)
            )
            density = sigma_t[int(numbers.random() * 3)]
            if -np.log(1.0 - numbers.random()) < density * (hit.t if hit.is_valid() else np.inf):
                return ray, hit, sigma_s / np.maximum(sigma_t, 1e-30)
        if not hit.is_valid() or hit.bsdf() is None or not is_bound(hit.bsdf(), True):
            break
        medium = hit.target_medium(ray.d)
        ray = mi.Ray3f(hit.spawn_ray(ray.d))
    return ray, hit, None
