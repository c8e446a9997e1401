"""Whether the rig belongs to the images at all, told from the dots of both and from nothing else.

True pairs of dots lie on one another's epipolar lines and meet in front of the cameras. Where too few do, or lie too
far off, the rig is wrong, and a few ways to be wrong are tried: cameras exchanged, a baseline or transform the other
way round, images free of distortion, a camera that has turned, another lens. Only what explains the same dots far
better is told. Knows no map and no pose.

A wrong *length* of the baseline changes no epipolar line. It scales everything, and only a known length can tell: the
diameter of the targets, where the option gives it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, log
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.geometry.camera import Camera, StereoRig
from trifix.geometry.pose import Pose, exp_rotation, skew
from trifix.records import Dots, Step, StereoDots
from trifix.stages.match import MatchOptions

_FRAMES = 16  # looked at together, spread over the run
_DOTS = 60  # of the left image of each, and ten times as many of the right one
_FEWEST = 5  # dots that either image must have
_WIDE_PX = 40.0  # farther from its line, no pair is looked at
_DECISIVE = log(1e6)  # of a likelihood ratio
_ILL_PX, _ILL_RATIO = 0.4, 1.5  # misfits below this, or this many times the dots' own errors, are no worry
_BETTER = 2.0  # how many times as many pairs, or as good ones, an explanation must find
_ENOUGH, _FEW = 0.3, 0.15  # shares of the dots: that must have a partner then; that are hardly any
_SIZES = 50  # dots to await before their size is judged
_COARSE_PX = 4.0  # steps by which turned cameras are sought
_PRIOR = np.array([0.02, 0.02, 0.02, 0.005, 0.005, 0.1, 0.1])  # of the changes: rad, and of k1
_SIZE_RATIO = 1.2  # by which the targets' diameters may be off


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One frame as rays: homogeneous slopes of its dots, and the rig between them."""

    left: Float[np.ndarray, "n 3"]
    right: Float[np.ndarray, "m 3"]
    T_right_left: Pose
    per_slope_px: tuple[float, float]
    """Focal lengths, as the scale of either image."""
    excludes: Bool[np.ndarray, "n m"]
    """Pairs whose labels contradict each other."""


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a rig pairs the dots of some frames."""

    share: float
    """Of the left dots, those with a partner that is no chance."""
    sigma_px: float
    """Root mean square distance of these partners from their epipolar lines, in ``StereoMatches``' units (px)."""
    gain: float
    """Logarithm of the likelihood ratio against dots that have nothing to do with one another."""

    def __str__(self) -> str:
        if self.share < _FEW:
            return f"hardly a dot ({100 * self.share:.0f} %) has a partner on its epipolar line, before both cameras"
        return f"{100 * self.share:.0f} % of the dots have a partner, {self.sigma_px:.2g} px rms off its epipolar line"


class _Explanation(NamedTuple):
    """A rig that might be meant, and how well it does."""

    fit: Fit
    how: str
    question: str


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """All pairs of some frames near their epipolar lines and in front of the cameras."""

    misfit_px: Float[np.ndarray, "p"]
    dot: Int[np.ndarray, "p"]
    """Number of the left dot, counted through all frames."""
    dots: int
    """How many left dots there are."""
    view: Int[np.ndarray, "p"]
    row: Int[np.ndarray, "p 2"]
    depth_mm: Float[np.ndarray, "p"]
    reach_px: float


class RigCheck:
    """Watches Steps, and says in one sentence what is wrong with the rig, if it can tell.

    It thinks anew whenever four times as many frames have passed, and at the end.
    """

    def __init__(self, options: MatchOptions = MatchOptions()) -> None:
        self._options = options
        self._frames: list[tuple[StereoDots, StereoRig]] = []
        self._stride, self._seen, self._due = 1, 0, 4
        self._is_new = False
        self._sentence = ""

    def watch(self, step: Step) -> None:
        """Look at the next frame."""
        if step.dots is None or step.frame.rig is None or min(len(step.dots.left), len(step.dots.right)) < _FEWEST:
            return
        if self._seen % self._stride == 0:
            self._frames.append((step.dots, step.frame.rig))
            self._is_new = True
            if len(self._frames) == 2 * _FRAMES:
                self._frames, self._stride = self._frames[::2], 2 * self._stride
        self._seen += 1
        if self._seen == self._due:
            self._due *= 4
            self._think()

    @property
    def sentence(self) -> str:
        """What is wrong, with numbers; empty as long as nothing seems to be."""
        return self._sentence

    def finish(self) -> str:
        """The same when the last frame has passed, and all have their say."""
        if self._is_new:
            self._think()
        return self._sentence

    def _think(self) -> None:
        self._is_new = False
        frames = self._frames[:: -(-len(self._frames) // _FRAMES)]
        self._sentence = diagnosis(frames, self._options) or wrong_size(frames, self._options)


def diagnosis(frames: Sequence[tuple[StereoDots, StereoRig]], options: MatchOptions = MatchOptions()) -> str:
    """A sentence that says how the rig does not fit the dots of some frames, and what would; empty if it may fit."""
    if not frames:
        return ""
    expected_px = float(np.median(np.concatenate([_sigmas_px(dots) for dots, _ in frames])))
    views = [_view(dots, rig) for dots, rig in frames]
    given = fit(views, options)
    worry_px = max(_ILL_PX, _ILL_RATIO * expected_px)
    is_sound = given.gain > _DECISIVE and given.sigma_px < worry_px
    if is_sound and given.share > 0.5:
        return ""

    def explains(other: _Explanation) -> bool:
        now = other.fit
        finds_more = now.share > _BETTER * given.share and now.sigma_px < worry_px
        fits_better = given.sigma_px > worry_px and now.sigma_px * _BETTER < given.sigma_px
        return now.gain > given.gain + _DECISIVE and now.share > _ENOUGH and (finds_more or fits_better)

    anywhere = replace(options, min_depth_mm=1e-6, max_depth_mm=1e9)
    narrow = "are match.min_depth_mm and max_depth_mm too narrow"
    tried = [_Explanation(fit(views, anywhere), "between any depths", narrow)]
    for change, how, question in _CHANGES:
        tried.append(_Explanation(fit([_view(*change(*frame)) for frame in frames], options), how, question))
    if not is_sound and not any(explains(each) and each.fit.sigma_px < worry_px for each in tried):
        tried += _adjusted(views, options)
    good = [each for each in tried if explains(each)]
    best = max((each.fit.gain for each in good), default=inf)
    for each in good:  # the simplest first
        if each.fit.gain > 0.9 * best:
            return (
                f"Rig and images do not agree: {given} (expected {expected_px:.2g}); {each.how}, {each.fit}: "
                f"{each.question}?"
            )
    if given.gain < _DECISIVE and _gain(_pairs(views, options), _ENOUGH, worry_px) < -_DECISIVE:
        return (
            f"Rig and images do not agree: {given}: is the rig that of other images, were the cameras not triggered "
            "together, or are the dots no targets?"
        )
    return ""


def wrong_size(frames: Sequence[tuple[StereoDots, StereoRig]], options: MatchOptions) -> str:
    """A sentence if the targets have another diameter than the one given; empty if not, or if none is given."""
    if not options.target_diameter_mm:
        return ""
    sizes = []
    for dots, rig in frames:
        pairs = _pairs([_view(dots, rig)], options)
        near = np.abs(pairs.misfit_px) < 3 * np.median(_sigmas_px(dots))
        once = np.flatnonzero(near & (np.bincount(pairs.dot[near], minlength=pairs.dots)[pairs.dot] == 1))
        left = dots.left.ellipse[:: _stride(len(dots.left), _DOTS)][pairs.row[once, 0]]
        sizes.append(2 * left[:, 0] * pairs.depth_mm[once] / rig.left.fu_px)  # a circle keeps its long axis
    size_mm = np.concatenate([np.zeros(0), *sizes])
    size_mm = size_mm[np.isfinite(size_mm)]
    if len(size_mm) < _SIZES:
        return ""
    ratio = float(np.median(size_mm)) / options.target_diameter_mm
    if 1 / _SIZE_RATIO < ratio < _SIZE_RATIO:
        return ""
    return (
        f"The targets show as {np.median(size_mm):.3g} mm wide, and {options.target_diameter_mm:.3g} mm is given: "
        f"is the rig's baseline stated {max(ratio, 1 / ratio):.2g} times too {'long' if ratio > 1 else 'short'}?"
    )


# --- rigs that might be meant ----------------------------------------------------------------------------------------

Change = Callable[[StereoDots, StereoRig], tuple[StereoDots, StereoRig]]


def _exchanged(dots: StereoDots, rig: StereoRig) -> tuple[StereoDots, StereoRig]:
    return StereoDots(dots.right, dots.left), rig


def _reversed(dots: StereoDots, rig: StereoRig) -> tuple[StereoDots, StereoRig]:
    T = rig.T_right_left
    return dots, replace(rig, T_right_left=Pose(T.R, -T.t_mm))


def _inverted(dots: StereoDots, rig: StereoRig) -> tuple[StereoDots, StereoRig]:
    return dots, replace(rig, T_right_left=rig.T_right_left.inverse())


def _undistorted(dots: StereoDots, rig: StereoRig) -> tuple[StereoDots, StereoRig]:
    def plain(camera: Camera) -> Camera:
        return replace(camera, model="none", coefficients=())

    return dots, replace(rig, left=plain(rig.left), right=plain(rig.right))


_CHANGES: tuple[tuple[Change, str, str], ...] = (
    (_exchanged, "with left and right exchanged", "are the cameras swapped"),
    (_reversed, "with the baseline reversed", "has it the wrong sign"),
    (_inverted, "with the transform between the cameras inverted", "is it the other way round"),
    (_undistorted, "without the lenses' distortion", "are the images free of it already"),
)


def _adjusted(views: Sequence[_View], options: MatchOptions) -> list[_Explanation]:
    """What the dots themselves would have: another place of the right camera, other lenses, both."""
    moved, lenses = np.arange(7) < 5, np.arange(7) >= 5
    start = _start(views, options)
    found = []
    for free in (moved, lenses, moved | lenses):
        p = _adjust(views, np.zeros(7) if free is lenses else start, free, options)
        said, asked = [], []
        if free is not lenses:
            degrees = ", ".join(f"{each:.2f}" for each in np.degrees(p[:3]))
            said.append(f"the right camera turned by {degrees}° about its x, y and z axes")
            said.append(f"the baseline by {np.degrees(np.hypot(*p[3:5])):.2f}°")
            asked.append("has a camera moved since it was calibrated")
        if free is not moved:
            said.append(f"k1 changed by {p[5]:.2f} on the left and {p[6]:.2f} on the right")
            asked.append("is the distortion that of another lens")
        found.append(_Explanation(fit(views, options, p), "with " + " and ".join(said), " and ".join(asked)))
    return found


def _start(views: Sequence[_View], options: MatchOptions) -> Float[np.ndarray, "7"]:
    """A turn about the baseline and one about the optical axis by which pairs come nearest to their lines."""
    few = [replace(v, left=v.left[::2], excludes=v.excludes[::2]) for v in views[:: -(-len(views) // 6)]]
    about = views[0].T_right_left.t_mm / np.linalg.norm(views[0].T_right_left.t_mm)
    best, start = -inf, np.zeros(7)
    for roll in np.radians([0.0, -1.0, 1.0, -2.0, 2.0]):
        for px in sorted(range(-80, 81, 4), key=abs):
            p = np.zeros(7)
            p[:3] = about * px / views[0].per_slope_px[1] + [0.0, 0.0, roll]
            gain = _gain(_pairs(few, options, p, 4 * _COARSE_PX), 0.6, _COARSE_PX)
            if gain > best:
                best, start = gain, p
    return start


def _adjust(
    views: Sequence[_View], p: Float[np.ndarray, "7"], free: Bool[np.ndarray, "7"], options: MatchOptions
) -> Float[np.ndarray, "7"]:
    """The parameters by which pairs lie nearest to their lines: expectation-maximisation, from coarse to fine."""
    share, sigma_px = 0.6, _COARSE_PX
    for _ in range(30):
        now = [_changed(view, p) for view in views]
        pairs = _pairs(now, options, reach_px=max(6 * sigma_px, 3.0))
        w = _weights(pairs, share, sigma_px)
        J = _jacobian(now, pairs)[:, free]
        A = J.T @ (w[:, None] * J) + sigma_px**2 * np.diag(_PRIOR[free] ** -2)
        b = J.T @ (w * pairs.misfit_px) + sigma_px**2 * p[free] / _PRIOR[free] ** 2
        step = np.zeros(7)
        step[free] = np.linalg.solve(A, b)
        p = p - step
        before, total = sigma_px, float(w.sum())
        share = min(max(total / pairs.dots, 0.05), 0.98)
        rms_px = float(np.sqrt((w * pairs.misfit_px**2).sum() / max(total, 1e-9)))
        sigma_px = max(min(rms_px, 0.8 * sigma_px), 0.05)
        if np.abs(step).max() < 1e-6 and sigma_px > 0.99 * before:
            break
    return p


def _jacobian(views: Sequence[_View], pairs: _Pairs) -> Float[np.ndarray, "p 7"]:
    """Derivatives of the misfits (px) by the parameters that ``_changed`` takes, at zero."""
    J = np.zeros((len(pairs.view), 7))
    for number, view in enumerate(views):
        mine = pairs.view == number
        left, right = view.left[pairs.row[mine, 0]], view.right[pairs.row[mine, 1]]
        T = view.T_right_left
        t = T.t_mm / np.linalg.norm(T.t_mm)
        E = _essential(T)
        turns = [skew(t) @ skew(axis) @ T.R for axis in np.eye(3)]
        swings = [skew(np.cross(axis, t)) @ T.R for axis in _across(t)]
        for k, dE in enumerate((*turns, *swings)):
            J[mine, k] = ((left @ dE.T) * right).sum(axis=1)
        for k, (rays, lines) in enumerate(((left, right @ E), (right, left @ E.T)), start=5):
            J[mine, k] = -((rays * lines)[:, :2].sum(axis=1)) * (rays[:, :2] ** 2).sum(axis=1)
        variance_left, variance_right = _variances(right @ E, left @ E.T, view.per_slope_px)
        J[mine] /= np.sqrt(variance_left + variance_right)[:, None]
    return J


# --- how well a rig pairs the dots -----------------------------------------------------------------------------------


def fit(views: Sequence[_View], options: MatchOptions, p: Float[np.ndarray, "7"] | None = None) -> Fit:
    """The likeliest share of dots with a partner, and how far these lie from their lines."""
    pairs = _pairs(views, options, p)
    best = Fit(0.0, inf, -inf)
    for sigma_px in (0.2, 1.0, 5.0, 15.0):
        share = 0.5
        for _ in range(30):
            weight = _weights(pairs, share, sigma_px)
            total = float(weight.sum())
            share = min(max(total / max(pairs.dots, 1), 1e-3), 0.999)
            squares = float((weight * pairs.misfit_px**2).sum())
            sigma_px = min(max((squares / total) ** 0.5 if total > 0 else 0.0, 0.02), _WIDE_PX)
        gain = _gain(pairs, share, sigma_px)
        if gain > best.gain:
            best = Fit(share, sigma_px, gain)
    return best


def _ratios(pairs: _Pairs, share: float, sigma_px: float) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "d"]]:
    """Of each pair, the likelihood that it is true over that of chance; of each left dot, their sum and that of none.

    Chance brings pairs evenly: ``density`` of them a dot and pixel.
    """
    density = max(len(pairs.misfit_px), 1) / (2 * pairs.reach_px * max(pairs.dots, 1))
    each = np.exp(-0.5 * (pairs.misfit_px / sigma_px) ** 2) * (share / (np.sqrt(2 * np.pi) * sigma_px * density))
    return each, 1 - share + np.bincount(pairs.dot, each, minlength=pairs.dots)


def _gain(pairs: _Pairs, share: float, sigma_px: float) -> float:
    return float(np.log(_ratios(pairs, share, sigma_px)[1]).sum())


def _weights(pairs: _Pairs, share: float, sigma_px: float) -> Float[np.ndarray, "p"]:
    each, whole = _ratios(pairs, share, sigma_px)
    return np.asarray(each / whole[pairs.dot])


def _pairs(
    views: Sequence[_View], options: MatchOptions, p: Float[np.ndarray, "7"] | None = None, reach_px: float = _WIDE_PX
) -> _Pairs:
    """All pairs within reach of their epipolar lines that meet within the depth limits before both cameras."""
    found, first = [], 0
    for number, view in enumerate(views):
        now = view if p is None else _changed(view, p)
        misfit_px = _all_misfits(now)
        i, j = np.nonzero((np.abs(misfit_px) < reach_px) & ~now.excludes)
        T = now.T_right_left
        baseline_mm = float(np.linalg.norm(T.t_mm))
        near, far = options.min_depth_mm or baseline_mm, options.max_depth_mm or 15 * baseline_mm
        depth_left, depth_right = _depths(now.left[i], now.right[j], T)
        good = np.minimum(depth_left, depth_right) >= near
        good &= np.maximum(depth_left, depth_right) <= far
        i, j = i[good], j[good]
        found.append((misfit_px[i, j], i + first, np.full(len(i), number), np.c_[i, j], depth_left[good]))
        first += len(view.left)
    e, dot, view_of, row, depth = (np.concatenate(each) for each in zip(*found, strict=True))
    return _Pairs(e, dot, first, view_of, row, depth, reach_px)


def _view(dots: StereoDots, rig: StereoRig) -> _View:
    left, right = _thinned(dots.left, _DOTS), _thinned(dots.right, 10 * _DOTS)
    labels = left.label[:, None], right.label[None]
    return _View(
        _rays(rig.left, left),
        _rays(rig.right, right),
        rig.T_right_left,
        (rig.left.fu_px, rig.right.fu_px),
        (labels[0] != labels[1]) & (labels[0] >= 0) & (labels[1] >= 0),
    )


def _rays(camera: Camera, dots: Dots) -> Float[np.ndarray, "n 3"]:
    return np.asarray(np.c_[camera.unproject(dots.uv_px), np.ones(len(dots))])


def _stride(n: int, limit: int) -> int:
    return max(-(-n // limit), 1)


def _thinned(dots: Dots, limit: int) -> Dots:
    every = slice(None, None, _stride(len(dots), limit))
    return Dots(dots.uv_px[every], dots.cov_px2[every], dots.ellipse[every], dots.label[every], dots.row[every])


def _sigmas_px(dots: StereoDots) -> Float[np.ndarray, "n"]:
    """What the dots state of their errors, each along one axis."""
    both = np.concatenate([dots.left.cov_px2, dots.right.cov_px2])
    return np.asarray(np.sqrt(np.trace(both, axis1=1, axis2=2) / 2))


def _changed(view: _View, p: Float[np.ndarray, "7"]) -> _View:
    """The same with the right camera turned by p[:3], the baseline by p[3:5], and k1 changed by p[5:] in the lenses."""
    return replace(
        view,
        left=_bent(view.left, p[5]),
        right=_bent(view.right, p[6]),
        T_right_left=_turned(view.T_right_left, p),
    )


def _bent(rays: Float[np.ndarray, "n 3"], k1: float) -> Float[np.ndarray, "n 3"]:
    """Slopes undistorted by k1 once more: x_u (1 + k1 r_u²) = x, by two steps of a fixed point."""
    r2 = (rays[:, :2] ** 2).sum(axis=1, keepdims=True)
    undistorted = rays[:, :2] / (1 + k1 * r2 / (1 + k1 * r2) ** 2)
    return np.asarray(np.c_[undistorted, rays[:, 2]])


def _turned(T: Pose, p: Float[np.ndarray, "7"]) -> Pose:
    return Pose(exp_rotation(p[:3]) @ T.R, exp_rotation(p[3:5] @ _across(T.t_mm)) @ T.t_mm)


def _across(t: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Two directions across another."""
    return np.asarray(np.linalg.svd(t[None])[2][1:])


def _all_misfits(view: _View) -> Float[np.ndarray, "n m"]:
    """Sampson's distance of every pair (px): x_rightᵀ E x_left over what a pixel's error in every coordinate makes."""
    E = _essential(view.T_right_left)
    in_right, in_left = view.left @ E.T, view.right @ E  # epipolar lines
    variance_left, variance_right = _variances(in_left, in_right, view.per_slope_px)
    return np.asarray(in_right @ view.right.T / np.sqrt(variance_right[:, None] + variance_left))


def _variances(
    in_left: Float[np.ndarray, "m 3"], in_right: Float[np.ndarray, "n 3"], per_slope_px: tuple[float, float]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "n"]]:
    """What an error of one pixel in the left dot, and in the right one, makes of x_rightᵀ E x_left: epipolar lines."""
    left, right = (
        (lines[:, :2] ** 2).sum(axis=1) / f_px**2 for lines, f_px in zip((in_left, in_right), per_slope_px, strict=True)
    )
    return left, right


def _essential(T: Pose) -> Float[np.ndarray, "3 3"]:
    return np.asarray(skew(T.t_mm / np.linalg.norm(T.t_mm)) @ T.R)


def _depths(
    left: Float[np.ndarray, "p 3"], right: Float[np.ndarray, "p 3"], T_right_left: Pose
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Depths before either camera at which two rays come nearest to each other: HS 5.3."""
    a, t = left @ T_right_left.R.T, T_right_left.t_mm  # s a + t nearest to q right
    aa, rr, ar = (a * a).sum(axis=1), (right * right).sum(axis=1), (a * right).sum(axis=1)
    at, rt = a @ t, right @ t
    det = aa * rr - ar * ar
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel rays meet nowhere
        return np.asarray((ar * rt - rr * at) / det), np.asarray((aa * rt - ar * at) / det)
