//! Vectors, rotations and quaternions of the drones, in f64.
//!
//! Plain multiplications and additions in a fixed order: the same bits on every machine.

/// A vector.
pub type V3 = [f64; 3];

#[inline]
pub(crate) fn add(a: V3, b: V3) -> V3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// a − b.
#[inline]
pub fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline]
pub(crate) fn scale(a: V3, s: f64) -> V3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// Element by element.
#[inline]
pub(crate) fn times(a: V3, b: V3) -> V3 {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

#[inline]
pub(crate) fn dot(a: V3, b: V3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline]
pub(crate) fn cross(a: V3, b: V3) -> V3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Euclidean length.
#[inline]
pub fn norm(a: V3) -> f64 {
    libm::sqrt(dot(a, a))
}

/// A rotation matrix, rows outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mat3(pub [V3; 3]);

impl Mat3 {
    /// The rotation of a unit quaternion.
    #[inline]
    pub fn of([x, y, z, w]: [f64; 4]) -> Self {
        let (x2, y2, z2) = (x + x, y + y, z + z);
        let (xx, yy, zz) = (x * x2, y * y2, z * z2);
        let (xy, xz, yz) = (x * y2, x * z2, y * z2);
        let (wx, wy, wz) = (w * x2, w * y2, w * z2);
        Self([
            [1.0 - (yy + zz), xy - wz, xz + wy],
            [xy + wz, 1.0 - (xx + zz), yz - wx],
            [xz - wy, yz + wx, 1.0 - (xx + yy)],
        ])
    }

    /// The matrix whose columns are three vectors.
    #[inline]
    pub fn columns(x: V3, y: V3, z: V3) -> Self {
        Self([[x[0], y[0], z[0]], [x[1], y[1], z[1]], [x[2], y[2], z[2]]])
    }

    /// Body axis k in the world.
    #[inline]
    pub fn axis(&self, k: usize) -> V3 {
        [self.0[0][k], self.0[1][k], self.0[2][k]]
    }

    /// Body to world.
    #[inline]
    pub fn turn(&self, v: V3) -> V3 {
        [dot(self.0[0], v), dot(self.0[1], v), dot(self.0[2], v)]
    }

    /// World to body.
    #[inline]
    pub fn back(&self, v: V3) -> V3 {
        [dot(self.axis(0), v), dot(self.axis(1), v), dot(self.axis(2), v)]
    }
}

/// The product of two quaternions: first `b`, then `a`.
#[inline]
pub fn product(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    ]
}

/// A quaternion of length 1.
#[inline]
pub(crate) fn unit([x, y, z, w]: [f64; 4]) -> [f64; 4] {
    let length = libm::sqrt(x * x + y * y + z * z + w * w);
    [x / length, y / length, z / length, w / length]
}

/// Roll, pitch and yaw of a unit quaternion: turns about the fixed axes x, y, z in this order, R = Rz Ry Rx.
/// At the poles (|sin pitch| ≥ 0.99999) roll is 0.
#[inline]
pub(crate) fn roll_pitch_yaw([x, y, z, w]: [f64; 4]) -> V3 {
    let s = sine_of_pitch([x, y, z, w]);
    if s >= POLE {
        [0.0, std::f64::consts::FRAC_PI_2, 2.0 * libm::atan2(-x, y)]
    } else if s <= -POLE {
        [0.0, -std::f64::consts::FRAC_PI_2, 2.0 * libm::atan2(x, -y)]
    } else {
        let (xx, yy, zz, ww) = (x * x, y * y, z * z, w * w);
        [
            libm::atan2(2.0 * (y * z + w * x), ww - xx - yy + zz),
            libm::asin(s),
            libm::atan2(2.0 * (x * y + w * z), ww + xx - yy - zz),
        ]
    }
}

/// sin(pitch).
#[inline]
pub(crate) fn sine_of_pitch([x, y, z, w]: [f64; 4]) -> f64 {
    2.0 * (w * y - x * z)
}

/// |sin(pitch)| from which on roll and yaw are not told apart.
pub(crate) const POLE: f64 = 0.99999;
