"""Inner loops of the stripe detector.

A *profile* is one image column (or row) across the stripe; ``profiles`` is (N, M, C) uint8: N profiles of M samples in C
channels.
"""

from __future__ import annotations

import numpy as np
from numba import njit

CANDIDATES = 2
"""Peaks kept per profile: the highest, and the next one apart from it."""
SCALE = 128
"""Smoothed profiles are fixed-point numbers: the largest of 16-bit integers is found twenty times faster than of floats."""
_BACKGROUND_STEP = 8
_NOISE_STEP = 8
_LEAST_NOISE = 0.5
_ANNULUS = 5
"""Samples either side of the window that tell the local background."""
_PASSES = 2
_FWHM = 2.3548
_SHOT_GAIN = 0.1
"""Variance per grey level of signal: some ten electrons to a grey level, as small 8-bit sensors have."""
_UNEVEN = 0.15
_TOP = 0.85
_BLEACHED = 200
"""Grey level of any channel from which a pixel tells no colour: an overexposed line is white, whatever its laser."""


@njit(cache=True, nogil=True)
def noise_level(profiles, channel):  # type: ignore[no-untyped-def]
    """Return the noise of one sample in grey levels: from the median difference of neighbours, which structure hardly moves."""
    histogram = np.zeros(256, np.int64)
    for i in range(0, profiles.shape[0], _NOISE_STEP):
        for j in range(profiles.shape[1] - 1):
            histogram[abs(np.int64(profiles[i, j + 1, channel]) - np.int64(profiles[i, j, channel]))] += 1
    half = 0.5 * histogram.sum()
    below = 0.0
    for level in range(256):
        if below + histogram[level] >= half:
            # Differences are whole numbers: bin 0 is half as wide as the others.
            share = (half - below) / max(histogram[level], 1)
            median = 0.5 * share if level == 0 else level - 0.5 + share
            return max(median / (0.6745 * np.sqrt(2.0)), _LEAST_NOISE)
        below += histogram[level]
    return _LEAST_NOISE


@njit(cache=True, nogil=True)
def channel_strength(profiles, first, last):  # type: ignore[no-untyped-def]
    """Return for each channel the sum over every eighth profile of how far its brightest sample exceeds the mean."""
    strength = np.zeros(profiles.shape[2])
    for i in range(0, profiles.shape[0], _BACKGROUND_STEP):
        for c in range(profiles.shape[2]):
            total, best = 0.0, 0
            for j in range(first[i], last[i]):
                total += profiles[i, j, c]
                best = max(best, profiles[i, j, c])
            if last[i] > first[i]:
                strength[c] += best - total / (last[i] - first[i])
    return strength


@njit(cache=True, nogil=True, fastmath=True)
def smooth(lines, weights, out):  # type: ignore[no-untyped-def]
    """Convolve each line with a symmetric kernel; the ends are repeated.

    Args:
        lines: (N, M) uint8.
        weights: (K,) float32, the kernel from its middle outwards.
        out: (N, M) uint16, the result, grey levels times :data:`SCALE`.
    """
    count, samples, reach = lines.shape[0], lines.shape[1], len(weights) - 1
    row = np.empty(samples, np.float32)
    padded = np.empty(samples + 2 * reach, np.float32)
    for i in range(count):
        padded[:reach], padded[reach + samples :] = lines[i, 0], lines[i, samples - 1]
        middle = padded[reach : reach + samples]
        for j in range(samples):
            middle[j] = lines[i, j]
        for j in range(samples):
            row[j] = weights[0] * middle[j]
        for k in range(1, reach + 1):
            # Slices instead of j ± k: without index arithmetic the compiler vectorises the loop.
            below, above = padded[reach - k : reach - k + samples], padded[reach + k : reach + k + samples]
            for j in range(samples):
                row[j] += weights[k] * (below[j] + above[j])
        target = out[i]
        for j in range(samples):
            target[j] = np.uint16(row[j] * np.float32(SCALE) + np.float32(0.5))


@njit(cache=True, nogil=True)
def _highest(line, first, last, floor):  # type: ignore[no-untyped-def]
    """Return the sample of [first, last) with the highest value above ``floor``, −1 where there is none."""
    part = line[first:last]
    best = np.uint16(0)
    for j in range(len(part)):
        best = max(best, part[j])
    if not best > floor:
        return -1
    for j in range(len(part)):
        if part[j] == best:
            return first + j
    return -1


@njit(cache=True, nogil=True)
def _extent(line, peak, level):  # type: ignore[no-untyped-def]
    """Return where the smoothed profile falls below ``level`` left and right of ``peak``, between samples."""
    left, right, end = peak, peak, len(line) - 1
    while left > 0 and line[left - 1] >= level:
        left -= 1
    while right < end and line[right + 1] >= level:
        right += 1
    low, high = float(left), float(right)
    if left > 0:
        low -= (line[left] - level) / (float(line[left]) - line[left - 1])
    if right < end:
        high += (line[right] - level) / (float(line[right]) - line[right + 1])
    return low, high


@njit(cache=True, nogil=True, fastmath=True)
def _background(line):  # type: ignore[no-untyped-def]
    """Return the mean of every eighth sample not above the mean of all of them: the stripe and bright patches are out."""
    total, count = 0.0, 0
    for j in range(0, len(line), _BACKGROUND_STEP):
        total += line[j]
        count += 1
    mean = total / count
    low, number = 0.0, 0
    for j in range(0, len(line), _BACKGROUND_STEP):
        if line[j] <= mean:
            low += line[j]
            number += 1
    return low / number if number else mean


@njit(cache=True, nogil=True)
def _ground(line, peak, background):  # type: ignore[no-untyped-def]
    """Return the level of the bright surface that a peak stands on, found beside its top."""
    low, high = _extent(line, peak, background + _TOP * (line[peak] - background))
    apart = int(max(high - low, _ANNULUS))
    return max(line[max(int(low) - apart, 0)], line[min(int(high) + apart, len(line) - 1)], background)


@njit(cache=True, nogil=True)
def find_peaks(smoothed, first, last, threshold, ambiguity, max_width):  # type: ignore[no-untyped-def]
    """Find the highest peak of each smoothed profile, and a second one apart from it.

    Args:
        smoothed: (N, M) uint16, grey levels times :data:`SCALE`.
        first, last: (N,) int64, peaks are sought in [first, last).
        threshold: least height above the profile's background, grey levels.
        ambiguity: least height of the second peak, as a share of the first.
        max_width: pixels, peaks that seem wider are measured above the surface that they stand on.

    Returns:
        (N, 2, 4) float64: low and high end of the peak at half height, the height, the middle of the ends at a quarter of it;
        height zero where there is none.
    """
    found = np.zeros((len(smoothed), CANDIDATES, 4))
    for i in range(len(smoothed)):
        begin, end, line = max(first[i], 0), last[i], smoothed[i]
        if end - begin < 3:
            continue
        background = _background(line[begin:end])
        peak = _highest(line, begin, end, background + threshold * SCALE)
        for k in range(CANDIDATES):
            if peak < 0:
                break
            base = background
            low, high = _extent(line, peak, 0.5 * (line[peak] + base))
            if high - low > max_width:
                base = _ground(line, peak, background)
                if line[peak] - base < threshold * SCALE:
                    break
                low, high = _extent(line, peak, 0.5 * (line[peak] + base))
            height = line[peak] - base
            foot = _extent(line, peak, base + 0.25 * height)
            found[i, k, 0], found[i, k, 1], found[i, k, 2], found[i, k, 3] = low, high, height / SCALE, 0.5 * (foot[0] + foot[1])
            if k + 1 < CANDIDATES:
                peak = _second(line, begin, end, low, high, background + max(threshold * SCALE, ambiguity * height))
    return found


@njit(cache=True, nogil=True)
def _second(line, begin, end, low, high, floor):  # type: ignore[no-untyped-def]
    """Return the highest local maximum outside the peak [low, high]; the flank of that peak is none."""
    below = _highest(line, begin, max(int(low) - 1, begin), floor)
    above = _highest(line, min(int(high) + 2, end), end, floor)
    peak = above if below < 0 or (above >= 0 and line[above] > line[below]) else below
    if (peak > 0 and line[peak - 1] > line[peak]) or (0 <= peak < len(line) - 1 and line[peak + 1] > line[peak]):
        return -1
    return peak


@njit(cache=True, nogil=True)
def _mean(profiles, i, channel, first, last):  # type: ignore[no-untyped-def]
    """Return the mean of the samples [first, last) that exist, NaN where none does."""
    total, count = 0.0, 0
    for j in range(max(first, 0), min(last, profiles.shape[1])):
        total += profiles[i, j, channel]
        count += 1
    return total / count if count else np.nan


@njit(cache=True, nogil=True)
def _moments(profiles, i, channel, low, high, left, right):  # type: ignore[no-untyped-def]
    """Return Σ I, Σ I x of the window [low, high] above a background from left to right; samples that it cuts count in part."""
    total, weighted = 0.0, 0.0
    for j in range(max(int(np.floor(low + 0.5)), 0), min(int(np.floor(high + 0.5)), profiles.shape[1] - 1) + 1):
        inside = min(j + 0.5, high) - max(j - 0.5, low)
        value = inside * (profiles[i, j, channel] - left - (right - left) * (j - low) / (high - low))
        total += value
        weighted += value * j
    return total, weighted


@njit(cache=True, nogil=True)
def _sides(profiles, i, channel, centre, reach):  # type: ignore[no-untyped-def]
    """Return the mean grey level just outside ``centre`` ± ``reach``, below and above."""
    low, high = int(np.floor(centre - reach + 0.5)), int(np.floor(centre + reach + 0.5))
    left = _mean(profiles, i, channel, low - _ANNULUS, low)
    right = _mean(profiles, i, channel, high + 1, high + 1 + _ANNULUS)
    return (right if np.isnan(left) else left), (left if np.isnan(right) else right)


@njit(cache=True, nogil=True)
def _spread(profiles, i, channel, centre, half, background, noise):  # type: ignore[no-untyped-def]
    """Return Σ k² var(I_k) of sensor noise, Σ k² I_k² for speckle, and the highest I, in the window about ``centre``."""
    sensor, speckle, top = 0.0, 0.0, 0.0
    for j in range(max(int(centre - half + 0.5), 0), min(int(centre + half + 0.5), profiles.shape[1] - 1) + 1):
        value = max(profiles[i, j, channel] - background, 0.0)
        sensor += (j - centre) ** 2 * (noise**2 + _SHOT_GAIN * value)
        speckle += ((j - centre) * value) ** 2
        top = max(top, value)
    return sensor, speckle, top


@njit(cache=True, nogil=True)
def _bleached(profiles, i, j):  # type: ignore[no-untyped-def]
    brightest = 0
    for c in range(profiles.shape[2]):
        brightest = max(brightest, profiles[i, j, c])
    return brightest >= _BLEACHED


@njit(cache=True, nogil=True)
def _other_channels(profiles, i, channel, centre, half, reach, total):  # type: ignore[no-untyped-def]
    """Return Σ I of the mean of the other channels for a line of Σ I ``total``, as its pixels that are not overexposed tell.

    Zero where there are no other channels, or no such pixel.
    """
    count = profiles.shape[2]
    own, others = 0.0, 0.0
    for c in range(count):
        left, right = _sides(profiles, i, c, centre, reach)
        ground = 0.5 * (left + right)
        for j in range(max(int(centre - half + 0.5), 0), min(int(centre + half + 0.5), profiles.shape[1] - 1) + 1):
            if count > 1 and not _bleached(profiles, i, j):
                if c == channel:
                    own += profiles[i, j, c] - ground
                else:
                    others += profiles[i, j, c] - ground
    return total * max(others, 0.0) / ((count - 1) * own) if own > 0 and count > 1 else 0.0


@njit(cache=True, nogil=True)
def locate(profiles, channel, peaks, smoothing, noise, threshold, window_sigmas, max_width):  # type: ignore[no-untyped-def]
    """Return the centre of mass of each peak above its local background.

    The window reaches to where a line of that width and height sinks into the noise, sigma √(2 ln(height / noise)), at most
    ``window_sigmas``: further out it would only collect noise.

    Args:
        profiles: (N, M, C) uint8.
        channel: where the laser is seen.
        peaks: (N, 4), one for each profile as :func:`find_peaks` gives them.
        smoothing: sigma of the smoothing, pixels.
        noise: grey levels, of one sample.
        threshold: least height above either side.
        window_sigmas: the widest window.
        max_width: pixels, wider peaks are no laser line.

    Returns:
        (N, 8) float64: centre, peak I, Σ I, Σ k² var(I_k) of sensor noise, Σ k² I_k² for speckle (k from the centre), Σ I of
        the other channels' mean, lean (centre less the middle at a quarter of the height, as a share of the width), width; NaN
        where there is no line.
    """
    out = np.full((len(peaks), 8), np.nan)
    for i in range(len(peaks)):
        low, high, height, foot = peaks[i]
        width = np.sqrt(max((high - low) ** 2 - (_FWHM * smoothing) ** 2, 1.0))
        if not height > 0 or width > max_width:
            continue
        sigma = width / _FWHM
        half = max(sigma * min(np.sqrt(2 * np.log(max(height / noise, 2.0))), window_sigmas), 0.5 * width + 1.5)
        reach = max(half, window_sigmas * sigma)
        centre, total, left, right = 0.5 * (low + high), 0.0, 0.0, 0.0
        for _ in range(_PASSES):
            left, right = _sides(profiles, i, channel, centre, reach)
            # Sides this different belong to two surfaces, or one holds another line: the darker one is the background.
            if abs(left - right) > max(4 * noise, _UNEVEN * height):
                left = right = min(left, right)
            total, weighted = _moments(profiles, i, channel, centre - half, centre + half, left, right)
            if not total > 0 or abs(weighted / total - centre) > half:
                total = 0.0
                break
            centre = weighted / total
        if not total > 0:
            continue
        sensor, speckle, top = _spread(profiles, i, channel, centre, half, 0.5 * (left + right), noise)
        sides = _sides(profiles, i, channel, centre, reach)
        if top - (max(sides[0], sides[1]) - 0.5 * (left + right)) < threshold:
            continue
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = centre, top, total, sensor, speckle
        out[i, 5] = _other_channels(profiles, i, channel, centre, half, reach, total)
        out[i, 6] = (centre - foot) / (high - low)
        out[i, 7] = width
    return out
