//! Sizes of the drone task, SI units.

/// Drones start, and landmarks hang, at this height, m.
pub const HEIGHT: f32 = 1.5;
/// A landmark is covered when the centre of a drone that has not crashed is within this distance, m.
pub const COVER_RADIUS: f64 = 0.15;
/// A command changes the target velocity of an axis by this per second, m/s².
pub const ACCELERATION: f64 = 5.0;
/// Largest target velocity, m/s.
pub const MOST_SPEED: f64 = 2.0;

/// Defines a struct of constants; the values of the Crazyflie 2.X stand beside their meanings.
macro_rules! cf2x {
    ($(#[$meta:meta])* $name:ident { $($(#[$doc:meta])* $field:ident: $type:ty = $value:expr;)* }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name {
            $($(#[$doc])* pub $field: $type,)*
        }

        impl $name {
            /// The reference's Crazyflie 2.X.
            pub const CF2X: Self = Self { $($field: $value,)* };
        }
    };
}

pub(super) use cf2x;
