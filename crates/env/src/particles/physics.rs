//! The multi-agent particle environment's physics for W worlds side by side.
//!
//! Arrays are `[bodies][W]`: element w of every array belongs to world w, and no operation mixes lanes, so a world's
//! numbers do not depend on its neighbours. Per step: v ← (1 − damping) v + dt (u + F / m), x ← x + dt v (the other way
//! round with `position_first`), with u the control and F the contact forces at the positions before the step. Every pair closer than the sum of radii d0
//! (softly) repels along the line of centres with F = 100 k ln(1 + e^(−(d − d0)/k)).

use super::real::{Real, softplus};

/// Constants of the world.
#[derive(Debug, Clone, Copy)]
pub struct Physics<R> {
    /// Seconds per step.
    pub dt: R,
    /// 1 − damping: the share of the velocity kept.
    pub keep: R,
    /// Stiffness of a contact.
    pub contact_force: R,
    /// k, the softness of a contact in world units.
    pub margin: R,
    /// 1 / k.
    pub inverse_margin: R,
    /// Force of an action.
    pub sensitivity: R,
    /// Whether positions move with the velocity before the step, as today's mpe2 and JaxMARL have it.
    pub position_first: bool,
}

impl<R: Real> Physics<R> {
    /// From the constants of a recording.
    pub fn new(dt: f64, damping: f64, contact_force: f64, margin: f64, sensitivity: f64) -> Self {
        Self {
            dt: R::from_f64(dt),
            keep: R::from_f64(1.0 - damping),
            contact_force: R::from_f64(contact_force),
            margin: R::from_f64(margin),
            inverse_margin: R::from_f64(1.0 / margin),
            sensitivity: R::from_f64(sensitivity),
            position_first: false,
        }
    }

    /// The authors' constants.
    pub(crate) fn standard() -> Self {
        Self::new(0.1, 0.25, 100.0, 1e-3, 5.0)
    }
}

/// What two bodies are to each other.
#[derive(Debug, Clone, Copy)]
pub struct Pair<R> {
    /// Sum of the radii.
    pub touch: R,
    /// touch²; the pair counts as a hit below it. Negative if it never counts.
    pub touch2: R,
    /// reach²; no force from it on. Negative if the two never touch.
    pub reach2: R,
    /// Factor of the force on the first body.
    pub on_first: R,
    /// Factor of the force on the second body.
    pub on_second: R,
}

impl<R: Real> Pair<R> {
    /// Two movable bodies of equal mass.
    pub fn equal(physics: &Physics<R>, touch: f64) -> Self {
        let touch = R::from_f64(touch);
        // From there on a contact is exactly zero here.
        let reach = R::NEGLIGIBLE.mul_add(physics.margin, touch);
        Self { touch, touch2: touch * touch, reach2: reach * reach, on_first: R::ONE, on_second: R::ONE }
    }
}

/// The bodies of a world.
pub trait Bodies<R: Real> {
    /// The pair (i, j), i < j.
    fn pair(&self, i: usize, j: usize) -> Pair<R>;
    /// 1 / mass.
    #[inline(always)]
    fn inverse_mass(&self, _i: usize) -> R {
        R::ONE
    }
    /// Whether the body moves at all.
    #[inline(always)]
    fn movable(&self, _i: usize) -> bool {
        true
    }
    /// The largest reach² of any pair.
    fn reach2(&self) -> R;
}

/// Bodies of one size and mass 1: the agents of Simple Spread.
#[derive(Debug, Clone, Copy)]
pub struct Alike<R>(pub Pair<R>);

impl<R: Real> Bodies<R> for Alike<R> {
    #[inline(always)]
    fn pair(&self, _: usize, _: usize) -> Pair<R> {
        self.0
    }
    #[inline(always)]
    fn reach2(&self) -> R {
        self.0.reach2
    }
}

/// Agents, then balls, all of mass 1: the bodies of Push Ball.
#[derive(Debug, Clone, Copy)]
pub struct AgentsAndBalls<R> {
    agents: usize,
    /// Agent and agent, agent and ball, ball and ball.
    pairs: [Pair<R>; 3],
}

impl<R: Real> AgentsAndBalls<R> {
    /// `agents` agents, followed by balls; only agents that overlap with each other count as hits.
    pub fn new(physics: &Physics<R>, agents: usize, agent_radius: f64, ball_radius: f64) -> Self {
        let pair = |touch| Pair::equal(physics, touch);
        let uncounted = |touch| Pair { touch2: -R::ONE, ..pair(touch) };
        let pairs = [pair(2.0 * agent_radius), uncounted(agent_radius + ball_radius), uncounted(2.0 * ball_radius)];
        Self { agents, pairs }
    }
}

impl<R: Real> Bodies<R> for AgentsAndBalls<R> {
    #[inline(always)]
    fn pair(&self, i: usize, j: usize) -> Pair<R> {
        self.pairs[usize::from(i >= self.agents) + usize::from(j >= self.agents)]
    }
    #[inline(always)]
    fn reach2(&self) -> R {
        self.pairs.iter().fold(R::ZERO, |most, pair| if pair.reach2 > most { pair.reach2 } else { most })
    }
}

/// Pairs of bodies in some order, i < j, packed as i · 2^16 + j so that their order is that of the numbers.
pub type Pairs = Vec<u32>;

/// The pair (i, j), packed.
#[inline(always)]
pub(crate) fn pack(i: usize, j: usize) -> u32 {
    (i as u32) << 16 | j as u32
}

/// Lists every pair that is in reach in any of the W worlds, by rising i, then j, at the front of `pairs`; returns how
/// many there are.
pub fn find_pairs<R: Real, const W: usize, B: Bodies<R>>(
    bodies: &B,
    (x, y): (&[[R; W]], &[[R; W]]),
    pairs: &mut Pairs,
) -> usize {
    // Every pair is written, and the length moves on only if it is in reach: no branch to mispredict.
    let n = x.len();
    let room = n * n.saturating_sub(1) / 2 + 1;
    if pairs.len() < room {
        pairs.resize(room, 0);
    }
    let mut found = 0;
    for i in 0..n {
        let (xi, yi) = (x[i], y[i]);
        for (j, (xj, yj)) in (i + 1..).zip(x[i + 1..].iter().zip(&y[i + 1..])) {
            let reach2 = bodies.pair(i, j).reach2;
            let mut near = false;
            for w in 0..W {
                let (dx, dy) = (xi[w] - xj[w], yi[w] - yj[w]);
                near |= dx.mul_add(dx, dy * dy) < reach2;
            }
            pairs[found] = pack(i, j);
            found += usize::from(near);
        }
    }
    found
}

/// What contacts do to the bodies, `[bodies][W]` each.
pub struct Forces<'a, R, const W: usize> {
    /// Force along x.
    pub x: &'a mut [[R; W]],
    /// Force along y.
    pub y: &'a mut [[R; W]],
    /// Other bodies strictly closer than the sum of radii, as far as they count ([`Pair::touch2`]).
    pub hits: &'a mut [[R; W]],
}

impl<R: Real, const W: usize> Forces<'_, R, W> {
    /// Sums the contacts of the listed pairs at the given positions, in the order of the list.
    ///
    /// Lanes in which a pair is apart get exactly +0, which changes no sum: sums start at +0 and round to nearest, so
    /// they are never −0.
    pub fn sum<B: Bodies<R>>(
        &mut self,
        physics: &Physics<R>,
        bodies: &B,
        (x, y): (&[[R; W]], &[[R; W]]),
        pairs: &[u32],
    ) {
        for lanes in [&mut *self.x, &mut *self.y, &mut *self.hits] {
            lanes.fill([R::ZERO; W]);
        }
        let stiffness = physics.contact_force * physics.margin;
        for &packed in pairs {
            let (i, j) = ((packed >> 16) as usize, (packed & 0xffff) as usize);
            let pair = bodies.pair(i, j);
            let (mut fx, mut fy, mut hit) = ([R::ZERO; W], [R::ZERO; W], [R::ZERO; W]);
            let (xi, yi, xj, yj) = (&x[i], &y[i], &x[j], &y[j]);
            for w in 0..W {
                let (dx, dy) = (xi[w] - xj[w], yi[w] - yj[w]);
                let d2 = dx.mul_add(dx, dy * dy);
                let d = d2.sqrt();
                let force = stiffness * softplus((pair.touch - d) * physics.inverse_margin);
                // Coincident centres have no line of centres: the body of lower index is pushed towards +x.
                let apart = d2 > R::ZERO;
                let per_length = if apart { force / d } else { force };
                let along_x = if apart { dx } else { R::ONE };
                let near = d2 < pair.reach2;
                fx[w] = if near { along_x * per_length } else { R::ZERO };
                fy[w] = if near { dy * per_length } else { R::ZERO };
                hit[w] = if d2 < pair.touch2 { R::ONE } else { R::ZERO };
            }
            add(&mut self.x[i], pair.on_first, &fx);
            add(&mut self.y[i], pair.on_first, &fy);
            add(&mut self.hits[i], R::ONE, &hit);
            add(&mut self.x[j], -pair.on_second, &fx);
            add(&mut self.y[j], -pair.on_second, &fy);
            add(&mut self.hits[j], R::ONE, &hit);
        }
    }
}

#[inline(always)]
fn add<R: Real, const W: usize>(sum: &mut [R; W], factor: R, term: &[R; W]) {
    for w in 0..W {
        sum[w] += factor * term[w];
    }
}

/// Velocities and positions of W worlds, `[bodies][W]` each.
pub struct Motion<'a, R, const W: usize> {
    /// Positions along x.
    pub x: &'a mut [[R; W]],
    /// Positions along y.
    pub y: &'a mut [[R; W]],
    /// Velocities along x.
    pub vx: &'a mut [[R; W]],
    /// Velocities along y.
    pub vy: &'a mut [[R; W]],
}

impl<R: Real, const W: usize> Motion<'_, R, W> {
    /// One step under the contact forces (`fx`, `fy`) of the present positions; `control` gives the control
    /// acceleration of a body in every lane.
    #[inline(always)]
    pub fn advance<B: Bodies<R>>(
        &mut self,
        physics: &Physics<R>,
        bodies: &B,
        (fx, fy): (&[[R; W]], &[[R; W]]),
        control: impl Fn(usize) -> ([R; W], [R; W]),
    ) {
        if physics.position_first {
            for i in (0..self.x.len()).filter(|&i| bodies.movable(i)) {
                for w in 0..W {
                    self.x[i][w] = physics.dt.mul_add(self.vx[i][w], self.x[i][w]);
                    self.y[i][w] = physics.dt.mul_add(self.vy[i][w], self.y[i][w]);
                }
            }
            self.push::<B, false>(physics, bodies, (fx, fy), control);
        } else {
            self.push::<B, true>(physics, bodies, (fx, fy), control);
        }
    }

    /// New velocities, and with them new positions if `MOVE`. A constant: the loop of a rollout has no branch.
    #[inline(always)]
    fn push<B: Bodies<R>, const MOVE: bool>(
        &mut self,
        physics: &Physics<R>,
        bodies: &B,
        (fx, fy): (&[[R; W]], &[[R; W]]),
        control: impl Fn(usize) -> ([R; W], [R; W]),
    ) {
        let n = self.x.len();
        let (x, y, vx, vy) = (&mut self.x[..n], &mut self.y[..n], &mut self.vx[..n], &mut self.vy[..n]);
        let (fx, fy) = (&fx[..n], &fy[..n]);
        for i in 0..n {
            if !bodies.movable(i) {
                continue;
            }
            let (ux, uy) = control(i);
            let inverse_mass = bodies.inverse_mass(i);
            for w in 0..W {
                let ax = fx[i][w].mul_add(inverse_mass, ux[w]);
                let ay = fy[i][w].mul_add(inverse_mass, uy[w]);
                vx[i][w] = physics.dt.mul_add(ax, physics.keep * vx[i][w]);
                vy[i][w] = physics.dt.mul_add(ay, physics.keep * vy[i][w]);
                if MOVE {
                    x[i][w] = physics.dt.mul_add(vx[i][w], x[i][w]);
                    y[i][w] = physics.dt.mul_add(vy[i][w], y[i][w]);
                }
            }
        }
    }
}
