"""The batch problem of camera and IMU as a factor graph: every frame's pose, velocity and biases, and what is calibrated.

The world's z points up; the board's origin is the world's. Unknown besides the states are ``E`` = T_cam_imu, ``G`` =
R_world_board (whose yaw is free), ``D`` = the time offset beyond the one at which the IMU was preintegrated, and ``A`` = gravity
beyond the nominal one, as this accelerometer measures it (its scale error included).

Neither D nor A is known to GTSAM's factors of the IMU. D enters at the camera: it sees X moved by D along its own velocity. A
enters there too: in a world that falls with A the IMU's factors stay as they are, and the board rises by A t²/2. Both are exact
where D = A = 0, to which the caller iterates; A t² is metres, which attitudes that still turn would throw about, hence
``gravity_sigma``.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from vli_calibration.board_track import BoardTrack
from vli_calibration.imu_camera_solution import Solution
from vli_calibration.imu_camera_states import A, D, E, FrameStates, G, RigState, b_key, v_key, x_key
from vli_calibration.imu_intervals import LONGEST_STEP_S, ImuIntervals
from vli_common.arrays import FloatArray
from vli_common.geometry import inverse, skew

_YAW_SIGMA = 1.0
NOMINAL_GRAVITY = 9.806
"""m/s², at middle latitudes near sea level."""
GRAVITY_SIGMA = 0.1
"""m/s²: latitude, height, and up to one per cent of scale error."""
_ACCEL_BIAS_SIGMA, _GYRO_BIAS_SIGMA = 1.0, 0.1
_TIMESHIFT_SIGMA = 0.1


class Batch:
    """The graph for one set of frames; built anew for each time offset."""

    def __init__(self, track: BoardTrack, intervals: ImuIntervals) -> None:
        self._track, self._intervals = track, intervals
        self._camera_s = intervals.camera_seconds(track)
        self._middle_s = float(self._camera_s.mean())

    def solve(self, rig: RigState, frames: FrameStates, gravity_sigma: float = GRAVITY_SIGMA) -> Solution:
        """Return the most likely states near the given ones.

        Args:
            rig, frames: where to start.
            gravity_sigma: how well gravity is known beforehand, m/s².

        Raises:
            RuntimeError: GTSAM finds the problem indeterminate.
        """
        graph = self._graph(rig, frames, gravity_sigma)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(30)
        params.setRelativeErrorTol(1e-7)
        # Millimetres of A t² and micrometres of the board in one matrix: squared, as Cholesky does, that is beyond doubles.
        params.setLinearSolverType("MULTIFRONTAL_QR")
        params.setOrdering(_ordering(len(self._track)))
        values = gtsam.LevenbergMarquardtOptimizer(graph, self._values(rig, frames), params).optimize()
        return Solution(graph, values, rig, self._camera_s - self._middle_s)

    def chi_squared(self, solution: Solution) -> FloatArray:
        """Return how far each frame's board is from where the solution expects it, (F,) χ² of six."""
        return np.array([2 * solution.graph.at(index).error(solution.values) for index in range(len(self._track))])

    def _graph(self, rig: RigState, frames: FrameStates, gravity_sigma: float) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        seconds = self._camera_s + rig.timeshift_s
        measured = self._intervals.at(seconds)
        for index in range(len(self._track)):
            rate = measured[index, :3] - frames.biases[index, 3:]
            fallen_s = float(self._camera_s[index]) - self._middle_s
            graph.add(_camera_factor(index, self._track.T_cam_board[index], self._track.roots[index], rate, fallen_s))
        params = self._intervals.params(rig.gravity)
        for index in range(len(self._track) - 1):
            graph.add(self._imu_factor(index, seconds, frames.biases[index], params))
        _add_priors(graph, rig, gravity_sigma)
        return graph

    def _imu_factor(self, index: int, seconds: FloatArray, bias: FloatArray, params: gtsam.PreintegrationCombinedParams) -> Any:
        """Return the factor between two frames; far ones share nothing but a constant bias, more or less."""
        start, end = float(seconds[index]), float(seconds[index + 1])
        if end - start > LONGEST_STEP_S:
            walk = np.sqrt(end - start) * np.sqrt(
                np.concatenate([np.diag(params.getBiasAccCovariance()), np.diag(params.getBiasOmegaCovariance())])
            )
            noise = gtsam.noiseModel.Diagonal.Sigmas(walk)
            return gtsam.BetweenFactorConstantBias(b_key(index), b_key(index + 1), gtsam.imuBias.ConstantBias(), noise)
        measured = self._intervals.preintegrate(start, end, bias, params)
        return gtsam.CombinedImuFactor(
            x_key(index), v_key(index), x_key(index + 1), v_key(index + 1), b_key(index), b_key(index + 1), measured
        )

    def _values(self, rig: RigState, frames: FrameStates) -> gtsam.Values:
        values = gtsam.Values()
        for index, (T, velocity, bias) in enumerate(zip(frames.T_world_imu, frames.velocity, frames.biases, strict=True)):
            values.insert(x_key(index), gtsam.Pose3(T))
            values.insert(v_key(index), velocity)
            values.insert(b_key(index), gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
        values.insert(E, gtsam.Pose3(rig.T_cam_imu))
        values.insert(G, gtsam.Rot3(rig.R_world_board))
        values.insert(D, np.zeros(1))
        values.insert(A, np.zeros(1))
        return values


def _ordering(count: int) -> gtsam.Ordering:
    """Return the states in order of time and what they share at the end: the elimination stays as narrow as the chain."""
    ordering = gtsam.Ordering()
    for index in range(count):
        for key in (v_key(index), b_key(index), x_key(index)):
            ordering.push_back(key)
    for key in (A, G, D, E):
        ordering.push_back(key)
    return ordering


def _add_priors(graph: gtsam.NonlinearFactorGraph, rig: RigState, gravity_sigma: float) -> None:
    """Add what is known beforehand: loosely, but for the free yaw of the world."""
    isotropic, diagonal = gtsam.noiseModel.Isotropic.Sigma, gtsam.noiseModel.Diagonal.Sigmas
    graph.add(gtsam.PriorFactorRot3(G, gtsam.Rot3(rig.R_world_board), isotropic(3, _YAW_SIGMA)))
    graph.add(gtsam.PriorFactorVector(D, np.zeros(1), isotropic(1, _TIMESHIFT_SIGMA)))
    graph.add(gtsam.PriorFactorVector(A, np.array([NOMINAL_GRAVITY - rig.gravity]), isotropic(1, gravity_sigma)))
    biases = diagonal(np.repeat([_ACCEL_BIAS_SIGMA, _GYRO_BIAS_SIGMA], 3))
    graph.add(gtsam.PriorFactorConstantBias(b_key(0), gtsam.imuBias.ConstantBias(), biases))


def _camera_factor(
    index: int, T_cam_board: FloatArray, root: FloatArray, rate: FloatArray, fallen_s: float
) -> gtsam.CustomFactor:
    """Return the factor of one frame's corners, six rows: W Log(measured⁻¹ predicted)."""
    T_board_cam = gtsam.Pose3(inverse(T_cam_board))
    rise = 0.5 * fallen_s**2

    def error(_: object, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        X, velocity = values.atPose3(x_key(index)), values.atVector(v_key(index))
        extrinsics, R_world_board = values.atPose3(E), values.atRot3(G)
        shift, gravity = float(values.atVector(D)[0]), float(values.atVector(A)[0])
        turned = gtsam.Rot3.Expmap(shift * rate)
        moved = gtsam.Pose3(X.rotation().compose(turned), X.translation() + shift * velocity)
        board = gtsam.Pose3(R_world_board, np.array([0.0, 0.0, gravity * rise]))
        board_in_imu = moved.inverse().compose(board)
        predicted = extrinsics.compose(board_in_imu)
        logarithm = gtsam.Pose3.Logmap(T_board_cam.compose(predicted))
        if jacobians is not None:
            R = moved.rotation().matrix()
            through = root @ _right_jacobian_inverse(logarithm)
            to_board = through @ board_in_imu.inverse().AdjointMap()
            back = np.zeros((6, 6))
            back[:3, :3] = turned.matrix().T
            back[3:, 3:] = turned.matrix().T
            jacobians[0] = -to_board @ back
            jacobians[1] = -to_board[:, 3:] @ R.T * shift
            jacobians[2] = to_board
            jacobians[3] = through[:, :3].copy()
            jacobians[4] = -(to_board[:, :3] @ rate + to_board[:, 3:] @ (R.T @ velocity))[:, None]
            jacobians[5] = (through[:, 3:] @ R_world_board.matrix()[2] * rise)[:, None]
        result: FloatArray = root @ logarithm
        return result

    keys = [x_key(index), v_key(index), E, G, D, A]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error)


def _right_jacobian_inverse(xi: FloatArray) -> FloatArray:
    """Return the inverse right Jacobian of SE(3) for a small ξ, to second order: I + ad/2 + ad²/12."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = skew(xi[:3])
    ad[3:, :3] = skew(xi[3:])
    result: FloatArray = np.eye(6) + 0.5 * ad + ad @ ad / 12
    return result
