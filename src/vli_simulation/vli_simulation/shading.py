"""Light on surfaces: where rays hit, what colour is there, how bright the light makes it.

All kernels work on rays that hit something; N is their number. World coordinates.
"""

from __future__ import annotations

import numba
import numpy as np

from vli_simulation.texture import fractal_noise, sample_tile, speck

AMBIENT = 0.045
"""Light that reaches every surface by reflection, as a share of direct light at the nominal distance."""
_STAIN_OCTAVES = 3
_GRAIN_OCTAVES = 5


@numba.njit(cache=True, nogil=True)
def surface_points(origin, directions, distance, u, v, triangle, faces, vertices, normals, points, shading_normals):
    """Fill ``points`` and interpolated unit ``shading_normals`` (N, 3), turned towards the viewer; zero where nothing was hit."""
    for n in range(len(triangle)):
        t = triangle[n]
        if t < 0:
            points[n, :] = 0.0
            shading_normals[n, :] = 0.0
            continue
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        w = 1.0 - u[n] - v[n]
        nx = w * normals[a, 0] + u[n] * normals[b, 0] + v[n] * normals[c, 0]
        ny = w * normals[a, 1] + u[n] * normals[b, 1] + v[n] * normals[c, 1]
        nz = w * normals[a, 2] + u[n] * normals[b, 2] + v[n] * normals[c, 2]
        facing = nx * directions[n, 0] + ny * directions[n, 1] + nz * directions[n, 2]
        scale = 1.0 / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        if facing > 0.0:
            scale = -scale
        shading_normals[n, 0], shading_normals[n, 1], shading_normals[n, 2] = nx * scale, ny * scale, nz * scale
        for axis in range(3):
            points[n, axis] = origin[axis] + distance[n] * np.float64(directions[n, axis])


@numba.njit(cache=True, nogil=True)
def surface_albedo(points, u, v, triangle, footprint, faces, material_of, tile_of, uv, materials, tiles, table, albedo):
    """Fill ``albedo`` (N, 3), order blue, green, red; ``footprint`` (N,) is the size of a pixel on the surface, metres."""
    for n in range(len(triangle)):
        t = triangle[n]
        if t < 0:
            albedo[n, :] = 0.0
            continue
        m = materials[material_of[t]]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        size = footprint[n]
        stain = fractal_noise(table, x + 0.31, y, z, m[9], _STAIN_OCTAVES, 0.6, size)
        mixed = min(max((stain - 1.2 + 2.0 * m[10]) * 0.8 + 0.1, 0.0), 1.0)
        grain = fractal_noise(table, x / m[14], y, z, m[11], _GRAIN_OCTAVES, m[13], size)
        gain = max(1.0 + m[12] * grain, 0.15)
        if m[16] > 0.0:
            gain *= 1.0 + m[17] * speck(x, y, z, m[15], m[16], size)
        ink = 0.0
        if tile_of[t] >= 0:
            a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
            w = 1.0 - u[n] - v[n]
            ink = sample_tile(
                tiles, tile_of[t], w * uv[a, 0] + u[n] * uv[b, 0] + v[n] * uv[c, 0], w * uv[a, 1] + u[n] * uv[b, 1] + v[n] * uv[c, 1]
            )
        for channel in range(3):
            k = 2 - channel
            base = (m[k] + mixed * (m[3 + k] - m[k])) * gain
            albedo[n, channel] = max(base + ink * (m[6 + k] * (0.6 + 0.4 * gain) - base), 0.0)


@numba.njit(cache=True, nogil=True)
def illuminate(points, normals, triangle, lit, material_of, materials, eye, light, light_axis, nominal, albedo, radiance):
    """Fill ``radiance`` (N, 3): 1 is a white surface that faces the light at ``nominal`` metres.

    Inverse-square and cosine fall-off, the LED's own cosine lobe about ``light_axis``, a Blinn–Phong highlight, and ambient light.
    """
    for n in range(len(triangle)):
        t = triangle[n]
        if t < 0:
            radiance[n, :] = 0.0
            continue
        m = materials[material_of[t]]
        lx, ly, lz = light[0] - points[n, 0], light[1] - points[n, 1], light[2] - points[n, 2]
        ex, ey, ez = eye[0] - points[n, 0], eye[1] - points[n, 1], eye[2] - points[n, 2]
        r2 = lx * lx + ly * ly + lz * lz
        r = np.sqrt(r2)
        e = np.sqrt(ex * ex + ey * ey + ez * ez)
        lobe = max(-(lx * light_axis[0] + ly * light_axis[1] + lz * light_axis[2]) / r, 0.0)
        strength = nominal * nominal / r2 * lobe
        diffuse = AMBIENT * (0.4 + 0.6 * nominal / e)
        highlight = 0.0
        if lit[n]:
            cosine = max((normals[n, 0] * lx + normals[n, 1] * ly + normals[n, 2] * lz) / r, 0.0)
            diffuse += strength * cosine
            hx, hy, hz = lx / r + ex / e, ly / r + ey / e, lz / r + ez / e
            h = np.sqrt(hx * hx + hy * hy + hz * hz)
            half = max((normals[n, 0] * hx + normals[n, 1] * hy + normals[n, 2] * hz) / h, 0.0)
            highlight = m[18] * strength * half ** m[19]
        for channel in range(3):
            radiance[n, channel] = albedo[n, channel] * diffuse + highlight * (0.4 + 0.6 * albedo[n, channel])


@numba.njit(cache=True, nogil=True)
def sheet_irradiance(points, normals, lit, origin, plane, waist, divergence, nominal, out):
    """Fill ``out`` (N,): 1 where a surface that faces the laser at ``nominal`` metres is cut by the middle of the sheet.

    The sheet's profile is Gaussian, sigma = waist + divergence · r; its power spreads over a line, hence 1/r, and over its width.
    """
    reference = waist + divergence * nominal
    for n in range(len(points)):
        out[n] = 0.0
        if not lit[n]:
            continue
        s = plane[0] * points[n, 0] + plane[1] * points[n, 1] + plane[2] * points[n, 2] + plane[3]
        x, y, z = origin[0] - points[n, 0], origin[1] - points[n, 1], origin[2] - points[n, 2]
        r = np.sqrt(x * x + y * y + z * z)
        sigma = waist + divergence * r
        if abs(s) > 4.5 * sigma:
            continue
        cosine = max((normals[n, 0] * x + normals[n, 1] * y + normals[n, 2] * z) / r, 0.0)
        out[n] = np.exp(-0.5 * (s / sigma) ** 2) * cosine * (nominal / r) * (reference / sigma)


@numba.njit(cache=True, nogil=True)
def edge_mask(depth, normals, triangle, material_of, lit, mask):
    """Mark pixels (H, W) at steps of depth, normal, material or shadow: there one ray a pixel is not enough."""
    height, width = depth.shape
    for i in range(height):
        for j in range(width):
            for di, dj in ((0, 1), (1, 0)):
                k, m = i + di, j + dj
                if k >= height or m >= width:
                    continue
                s, t = triangle[i, j], triangle[k, m]
                step = s < 0 or t < 0 or lit[i, j] != lit[k, m] or material_of[s] != material_of[t]
                if not step:
                    step = abs(depth[i, j] - depth[k, m]) > 0.012 * depth[i, j]
                if not step:
                    dot = (
                        normals[i, j, 0] * normals[k, m, 0] + normals[i, j, 1] * normals[k, m, 1] + normals[i, j, 2] * normals[k, m, 2]
                    )
                    step = dot < 0.97
                if step and (s >= 0 or t >= 0):
                    mask[i, j] = True
                    mask[k, m] = True


@numba.njit(cache=True, nogil=True)
def image_motion(rays, depth, jacobian, velocity, rate, flow):
    """Fill ``flow`` (H, W, 2): pixels a second at which surface points move in the image.

    Args:
        rays: (H, W, 2) undistorted rays; ``depth`` (H, W) along z, zero where nothing was hit.
        jacobian: (H, W, 2, 2) of the pixel by the ray.
        velocity, rate: (3,) of the camera in the camera frame; a fixed point moves by −v − ω × X.
    """
    height, width = depth.shape
    for i in range(height):
        for j in range(width):
            x, y = rays[i, j, 0], rays[i, j, 1]
            inverse = 1.0 / depth[i, j] if depth[i, j] > 0.0 else 0.0
            vx = -velocity[0] * inverse - (rate[1] - rate[2] * y)
            vy = -velocity[1] * inverse - (rate[2] * x - rate[0])
            vz = -velocity[2] * inverse - (rate[0] * y - rate[1] * x)
            dx, dy = vx - x * vz, vy - y * vz
            flow[i, j, 0] = jacobian[i, j, 0, 0] * dx + jacobian[i, j, 0, 1] * dy
            flow[i, j, 1] = jacobian[i, j, 1, 0] * dx + jacobian[i, j, 1, 1] * dy


@numba.njit(cache=True, nogil=True)
def smear(image, flow, exposure, samples, out):
    """Average ``image`` (H, W, C) along ``flow`` over an exposure that is centred on the image's instant."""
    height, width, channels = image.shape
    for i in range(height):
        for j in range(width):
            for c in range(channels):
                out[i, j, c] = 0.0
            for s in range(samples):
                share = ((s + 0.5) / samples - 0.5) * exposure
                x = min(max(j + share * flow[i, j, 0], 0.0), width - 1.001)
                y = min(max(i + share * flow[i, j, 1], 0.0), height - 1.001)
                a, b = int(x), int(y)
                p, q = np.float32(x - a), np.float32(y - b)
                for c in range(channels):
                    top = image[b, a, c] + p * (image[b, a + 1, c] - image[b, a, c])
                    bottom = image[b + 1, a, c] + p * (image[b + 1, a + 1, c] - image[b + 1, a, c])
                    out[i, j, c] += (top + q * (bottom - top)) / samples
