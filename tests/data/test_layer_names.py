"""Names of layers as programs and real-time denoisers write them: which buffer each is."""

from pathlib import Path

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.core.frame import FAR
from jaxdn.data.foreign.layers import detect_channels, layer_of
from jaxdn.data.foreign.lighting import coloured_layers
from tests.programs import HEIGHT, WIDTH, Channels, layer, truth


def names(layers: dict[str, str]) -> list[str]:
    """``{"N": "XYZ"}`` -> ``N.X`` ..."""
    return [f"{name}.{letter}" if name else letter for name, letters in layers.items() for letter in letters]


PROGRAMS = {
    "Blender's File Output": (
        {"Image": "RGBA", "Denoising Albedo": "RGB", "Depth": "V", "Vector": "XYZW"},
        {"radiance": "Image", "albedo": "Denoising Albedo", "depth": "Depth", "motion": "Vector"},
    ),
    "Unreal": (
        {"FinalImage": "RGBA", "FinalImageMovieRenderQueue_WorldDepth": "RGB", "ActorHitProxyMask": "RGB"},
        {"radiance": "FinalImage", "depth": "FinalImageMovieRenderQueue_WorldDepth"},
    ),
    "LuxCore": (
        {"RADIANCE": "RGB", "ALBEDO": "RGB", "AVG_SHADING_NORMAL": "XYZ", "DEPTH": "Z", "OBJECT_ID": "Y"},
        {
            "radiance": "RADIANCE", "albedo": "ALBEDO", "normal": "AVG_SHADING_NORMAL", "depth": "DEPTH",
            "ids": "OBJECT_ID",
        },
    ),
    "Corona": (
        {"": "RGB", "CShading_Albedo": "RGB", "CGeometry_NormalsShading": "RGB", "CGeometry_ZDepth": "R"},
        {"radiance": "R, G, B", "albedo": "CShading_Albedo", "normal": "CGeometry_NormalsShading",
         "depth": "CGeometry_ZDepth"},
    ),
    "DLSS-RR": (
        {"Color": "RGB", "DiffuseAlbedo": "RGB", "SpecularAlbedo": "RGB", "Normals": "XYZ", "Roughness": "R",
         "SpecularHitDistance": "R", "MotionVectors": "XY", "LinearDepth": "R"},
        {"radiance": "Color", "albedo": "DiffuseAlbedo", "specular_reflectance": "SpecularAlbedo", "normal": "Normals",
         "roughness": "Roughness", "specular_hit_distance": "SpecularHitDistance", "motion": "MotionVectors",
         "depth": "LinearDepth"},
    ),
    "MetalFX, other spellings": (
        {"Noisy_Color": "RGB", "diffuse-albedo": "RGB", "Specular Albedo": "RGB", "normal": "XYZ", "roughness": "R",
         "specular_hit_distance": "R", "Motion": "XY", "Depth": "R"},
        {"radiance": "Noisy_Color", "albedo": "diffuse-albedo", "specular_reflectance": "Specular Albedo",
         "normal": "normal", "roughness": "roughness", "specular_hit_distance": "specular_hit_distance",
         "motion": "Motion", "depth": "Depth"},
    ),
    "FSR-RR and NRD, roughness with the normals": (
        {"Radiance": "RGB", "Normal_Roughness": "RGBA", "ViewZ": "R", "MV": "XY", "spec_hit_dist": "R"},
        {"radiance": "Radiance", "normal": "Normal_Roughness", "roughness": "Normal_Roughness", "depth": "ViewZ",
         "motion": "MV", "specular_hit_distance": "spec_hit_dist"},
    ),
    "Streamline's tags": (
        {"kBufferTypeScalingInputColor": "RGB", "kBufferTypeScalingOutputColor": "RGB", "kBufferTypeAlbedo": "RGB",
         "kBufferTypeSpecularAlbedo": "RGB", "kBufferTypeNormals": "RGB", "kBufferTypeRoughness": "R",
         "kBufferTypeDepth": "R", "kBufferTypeMotionVectors": "RG", "kBufferTypeSpecularHitDistance": "R"},
        {"radiance": "kBufferTypeScalingInputColor", "albedo": "kBufferTypeAlbedo",
         "specular_reflectance": "kBufferTypeSpecularAlbedo", "normal": "kBufferTypeNormals",
         "roughness": "kBufferTypeRoughness", "depth": "kBufferTypeDepth", "motion": "kBufferTypeMotionVectors",
         "specular_hit_distance": "kBufferTypeSpecularHitDistance"},
    ),
    "Streamline's tags, roughness with the normals": (
        {"color": "RGB", "kBufferTypeNormalRoughness": "RGBA", "kBufferTypeLinearDepth": "R"},
        {"radiance": "color", "normal": "kBufferTypeNormalRoughness", "roughness": "kBufferTypeNormalRoughness",
         "depth": "kBufferTypeLinearDepth"},
    ),
    "arguments of DLSS-RR": (
        {"InColor": "RGB", "pInDiffuseAlbedo": "RGB", "pInSpecularAlbedo": "RGB", "InNormals": "XYZ",
         "InRoughness": "R", "InDepth": "R", "InMotionVectors": "XY", "InSpecHitDist": "R"},
        {"radiance": "InColor", "albedo": "pInDiffuseAlbedo", "specular_reflectance": "pInSpecularAlbedo",
         "normal": "InNormals", "roughness": "InRoughness", "depth": "InDepth", "motion": "InMotionVectors",
         "specular_hit_distance": "InSpecHitDist"},
    ),
    "short words": (
        {"noisyRadiance": "RGB", "InDiffAlbedo": "RGB", "InSpecAlbedo": "RGB"},
        {"radiance": "noisyRadiance", "albedo": "InDiffAlbedo", "specular_reflectance": "InSpecAlbedo"},
    ),
    "MetalFX": (
        {"colorTexture": "RGBA", "diffuseAlbedoTexture": "RGB", "specularAlbedoTexture": "RGB",
         "normalTexture": "RGB", "roughnessTexture": "R", "depthTexture": "R", "motionTexture": "RG",
         "specularHitDistanceTexture": "R", "outputTexture": "RGB"},
        {"radiance": "colorTexture", "albedo": "diffuseAlbedoTexture", "specular_reflectance": "specularAlbedoTexture",
         "normal": "normalTexture", "roughness": "roughnessTexture", "depth": "depthTexture",
         "motion": "motionTexture", "specular_hit_distance": "specularHitDistanceTexture"},
    ),
    "FSR-RR": (
        {"radiance": "RGBA", "fusedAlbedo": "RGBA", "normals": "XYZ", "linearDepth": "R", "motionVectors": "RG"},
        {"radiance": "radiance", "albedo": "fusedAlbedo", "normal": "normals", "depth": "linearDepth",
         "motion": "motionVectors"},
    ),
    "Open Image Denoise's tools": (
        {"hdr": "RGB", "alb": "RGB", "nrm": "RGB", "z": "R"},
        {"radiance": "hdr", "albedo": "alb", "normal": "nrm", "depth": "z"},
    ),
    "a part called Main": ({"Main": "RGBA", "albedo": "RGB"}, {"radiance": "Main", "albedo": "albedo"}),
    "V-Ray's frame buffer": (
        {"VRayRGB": "RGBA", "effectsResult": "RGB", "VRayZDepth": "R"}, {"radiance": "VRayRGB", "depth": "VRayZDepth"},
    ),
    "effects alone": ({"effectsResult": "RGB", "diffuseFilter": "RGB"},
                      {"radiance": "effectsResult", "albedo": "diffuseFilter"}),
    "noisy beside the denoised": ({"beauty": "RGB", "beauty_noisy": "RGB"}, {"radiance": "beauty_noisy"}),
    "noisy at the end": ({"beauty_noisy": "RGB", "depth": "Z"}, {"radiance": "beauty_noisy", "depth": "depth"}),
    "a view layer in front of a tag": (
        {"Room.InColor": "RGB", "Room.kBufferTypeDepth": "R"},
        {"radiance": "Room.InColor", "depth": "Room.kBufferTypeDepth"},
    ),
    "words that only begin alike": (
        {"": "RGB", "Texture": "RGB", "Indirect": "RGB", "IndexOB": "X"}, {"radiance": "R, G, B", "ids": "IndexOB"},
    ),
    "a view layer in front": (
        {"Room.Image": "RGB", "Room.Z-Depth": "Z", "Room.Denoising_Albedo": "RGB"},
        {"radiance": "Room.Image", "depth": "Room.Z-Depth", "albedo": "Room.Denoising_Albedo"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_layers_of_a_program_are_found(program: str) -> None:
    layers, expected = PROGRAMS[program]
    found = detect_channels(names(layers))
    assert {buffer: layer_of(channels) for buffer, channels in found.items()} == expected


def test_the_best_of_several_names_is_taken() -> None:
    """An image that somebody made beside the beauty is no beauty, and no part of it."""
    found = detect_channels(names({"": "RGB", "Image": "RGB", "Combined": "RGB", "RADIANCE": "RGB"}))
    assert found["radiance"] == ("R", "G", "B")
    there = names({"": "RGB", "Diffuse_Albedo": "RGB", "Diffuse-Light": "RGB", "Specular Albedo": "RGB"})
    assert set(coloured_layers(there, ("R", "G", "B"), {"radiance": ("R", "G", "B")})) == {"Diffuse-Light"}


def test_normals_alone_have_no_roughness_in_their_alpha() -> None:
    assert "roughness" not in detect_channels(names({"": "RGB", "Normals": "RGBA"}))
    stated = detect_channels(names({"": "RGB", "NormalRoughness": "XYZW"}), channels={"roughness": "none"})
    assert "roughness" not in stated


def guide_set(frame: int) -> Channels:
    """What real-time denoisers ask a game for."""
    now = truth(frame)
    distance = np.full((HEIGHT, WIDTH, 1), 2.5)
    distance[0, :5, 0] = 0, np.inf, -1, np.nan, 1e9
    normals = np.concatenate([now.normal, np.full((HEIGHT, WIDTH, 1), 0.3)], axis=-1)
    return (
        layer("Color", now.light, "RGB")
        | layer("DiffuseAlbedo", now.albedo, "RGB")
        | layer("SpecularAlbedo", now.specular_albedo, "RGB")
        | layer("NormalRoughness", normals, "RGBA")
        | layer("SpecularHitDistance", distance, "R")
        | layer("MotionVectors", now.motion, "XY")
        | layer("Depth", now.depth, "R")
    )


def test_the_guide_set_of_real_time_denoisers_is_read_and_denoised(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for frame in range(2):
        clips.write_exr(tmp_path / f"game.{frame:04d}.exr", guide_set(frame))
    frames = list(clips.plain_frames(tmp_path, motion_convention="previous-current")[1])
    now = truth(1)
    np.testing.assert_allclose(frames[1].albedo, now.albedo, rtol=1e-6)
    np.testing.assert_allclose(frames[1].reflectance, now.albedo + now.specular_albedo, rtol=1e-6)
    np.testing.assert_allclose(frames[1].normal, now.normal, rtol=1e-6)
    np.testing.assert_allclose(frames[1].roughness, 0.3, rtol=1e-6)
    np.testing.assert_allclose(frames[1].motion, now.motion, rtol=1e-6)
    np.testing.assert_array_equal(frames[1].specular_hit_distance[0, :6, 0], [0, FAR, 0, 0, FAR, 2.5])
    arguments = ["denoise", str(tmp_path), "-o", str(tmp_path / "out"), "--method", "svgf"]
    main.main([*arguments, "--motion-convention", "previous-current"])
    assert "2 frames denoised" in capsys.readouterr().out
    after = clips.read_exr(tmp_path / "out" / "game.0001.exr")
    assert np.abs(after["Color.R"] - now.light[..., 0]).max() > 0.01
    np.testing.assert_array_equal(after["MotionVectors.X"], now.motion[..., 0].astype(np.float32))
