//! Sizes that the particle tasks share.

/// Two agents collide when their centres are closer than this (two radii of 0.1).
pub const CONTACT_DISTANCE: f64 = 0.2;

/// Worlds stepped side by side: one vector register of f32 on the widest machines.
pub(crate) const LANES: usize = 16;

/// Bodies from which neighbours are found by cells instead of comparing all pairs of 16 worlds at once.
const CELLS_FROM: usize = 256;

/// Whether worlds of this many bodies share registers; otherwise each is looked at by itself, its neighbours found by cells.
/// Fewer than bodies / 16 worlds do not fill the registers well enough to be worth it. Both ways give the same bits.
pub(crate) fn share_registers(bodies: usize, worlds: usize) -> bool {
    bodies < CELLS_FROM && LANES * worlds >= bodies
}
