//! From raw positions, velocities and goals to what the networks see, as nodes of a graph. The formulas are those of docs/policy.md.

use super::graph::{Builder, Value};
use magex_core::config::{ExecutorConfig, Observes};
use magex_core::task::{Frame, Observation, PushBallConfig, TaskConfig};

/// Farther than anything.
const FAR: f32 = 1e30;

/// The inputs, and what is common to several features.
pub(super) struct Inputs<'a> {
    pub(super) task: &'a TaskConfig,
    pub(super) executor: &'a ExecutorConfig,
    pub(super) o: Observation,
    /// [B, N, D] each.
    pub(super) positions: Value,
    pub(super) velocities: Value,
    pub(super) goals: Value,
    /// Push Ball: positions and velocities of the balls.
    pub(super) balls: Option<(Value, Value)>,
    /// [B, N, X]
    pub(super) agent_state: Option<Value>,
    /// A number.
    pub(super) half_side: Value,
    pub(super) frame: Option<FrameValues>,
}

/// How every agent sees the world: [B, N, 2] signs, [B, N, 1] whether the axes are swapped.
pub(super) struct FrameValues {
    pub(super) sign: Value,
    pub(super) swap: Value,
}

impl Inputs<'_> {
    /// The frames of Push Ball, for executors that see relative goals.
    pub(super) fn find_frame(&mut self, g: &mut Builder) {
        let Some((balls, _)) = self.balls.as_ref().filter(|_| self.o.frame == Frame::Push) else { return };
        let (way, to) = (g.sub(&self.goals, balls), g.sub(balls, &self.positions));
        let (way, to) = (g.split(&way, &[1, 1]), g.split(&to, &[1, 1]));
        let (x, y) = (g.op("Abs", &[&way[0]]), g.op("Abs", &[&way[1]]));
        let swap = g.op("Greater", &[&y, &x]);
        let (a, b) = (g.mul(&to[0], &way[1]), g.mul(&to[1], &way[0]));
        let cross = g.sub(&a, &b);
        let (zero, plus, minus) = (g.scalar(0.0), g.scalar(1.0), g.scalar(-1.0));
        let along = g.choose(&swap, &way[1], &way[0]);
        let back = g.op("Less", &[&along, &zero]);
        let flip = g.op("Xor", &[&swap, &back]);
        let turned = g.op("Neg", &[&cross]);
        let left = g.choose(&flip, &turned, &cross);
        let right = g.op("Less", &[&left, &zero]);
        let (along, across) = (g.choose(&back, &minus, &plus), g.choose(&right, &minus, &plus));
        let (x, y) = (g.choose(&swap, &across, &along), g.choose(&swap, &along, &across));
        let sign = g.concat(-1, &[&x, &y]);
        self.frame = Some(FrameValues { sign, swap });
    }

    /// A vector of the world as each agent sees it: [B, N, D], or [B, N, k, D] with `many`.
    fn see(&self, g: &mut Builder, vector: &str, many: bool) -> Value {
        let Some(FrameValues { sign, swap }) = &self.frame else { return vector.to_owned() };
        let wide = |g: &mut Builder, value: &str| if many { g.unsqueeze(value, 2) } else { value.to_owned() };
        let (sign, swap) = (wide(g, sign), wide(g, swap));
        let signed = g.mul(vector, &sign);
        let order = g.ints(&[2], &[1, 0]);
        let swapped = g.gather(&signed, &order, -1);
        g.choose(&swap, &swapped, &signed)
    }

    fn join(&self, g: &mut Builder, mut parts: Vec<Value>) -> Value {
        parts.extend(self.agent_state.clone());
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        g.concat(-1, &parts)
    }

    /// 1 where x ≤ limit, else 0.
    fn within(g: &mut Builder, x: &str, limit: f32) -> Value {
        let limit = g.scalar(limit);
        let within = g.op("LessOrEqual", &[x, &limit]);
        g.cast_float(&within)
    }

    /// x / max(d, least)
    fn faded(g: &mut Builder, x: &str, d: &str, least: f32) -> Value {
        let d = g.at_least(d, least);
        g.div(x, &d)
    }

    /// x / (1 + d)
    fn squashed(g: &mut Builder, x: &str, d: &str) -> Value {
        let one = g.scalar(1.0);
        let d = g.add(d, &one);
        g.div(x, &d)
    }

    /// An agent and its goal, relative or absolute.
    pub(super) fn own(&self, g: &mut Builder, relative: bool) -> Value {
        let (p, v) = (&self.positions, &self.velocities);
        let o = &self.o;
        if !relative {
            let mut parts = vec![g.over(v, o.speed), g.div(p, &self.half_side)];
            for target in self.balls.iter().map(|(balls, _)| balls).chain([&self.goals]) {
                parts.push(g.div(target, &self.half_side));
            }
            return self.join(g, parts);
        }
        let seen = self.see(g, v, false);
        let mut parts = vec![g.over(&seen, o.speed)];
        let Some((balls, rolling)) = &self.balls else {
            let to = g.sub(&self.goals, p);
            let d = g.length(&to);
            parts.push(Self::faded(g, &to, &d, o.fade_radius));
            parts.push(Self::squashed(g, &to, &d));
            parts.push(Self::within(g, &d, o.success_radius));
            return self.join(g, parts);
        };
        let reach = PushBallConfig::PUSH_DISTANCE as f32;
        let (to, way) = (g.sub(balls, p), g.sub(&self.goals, balls));
        let (near, left) = (g.length(&to), g.length(&way));
        let back = g.scalar(reach);
        let back = Self::faded(g, &back, &left, o.fade_radius);
        let back = g.mul(&way, &back);
        let behind = g.sub(&to, &back);
        let (to, way, behind) = (self.see(g, &to, false), self.see(g, &way, false), self.see(g, &behind, false));
        parts.push(Self::faded(g, &to, &near, o.fade_radius));
        parts.push(Self::squashed(g, &to, &near));
        let close = g.times(&to, 3.0);
        parts.push(g.clip(&close, -1.0, 1.0));
        let rolling = self.see(g, rolling, false);
        parts.push(g.over(&rolling, o.speed));
        parts.push(Self::faded(g, &way, &left, o.fade_radius));
        parts.push(Self::squashed(g, &way, &left));
        let behind = g.times(&behind, 2.0);
        parts.push(g.clip(&behind, -2.0, 2.0));
        let (a, b) = (g.at_least(&near, 1e-6), g.at_least(&left, o.fade_radius));
        let legs = g.mul(&a, &b);
        let product = g.mul(&to, &way);
        let cosine = g.sum(&product, -1, true);
        parts.push(g.div(&cosine, &legs));
        let (t, w) = (g.split(&to, &[1, 1]), g.split(&way, &[1, 1]));
        let (a, b) = (g.mul(&t[0], &w[1]), g.mul(&t[1], &w[0]));
        let sine = g.sub(&a, &b);
        parts.push(g.div(&sine, &legs));
        let reach = g.scalar(reach);
        let closeness = Self::faded(g, &reach, &near, 1e-6);
        parts.push(g.at_most(&closeness, 2.0));
        parts.push(g.at_most(&left, 1.0));
        parts.push(Self::within(g, &left, o.success_radius));
        self.join(g, parts)
    }

    /// [N, N]: 1 on the diagonal, as booleans.
    pub(super) fn diagonal(&self, g: &mut Builder) -> Value {
        let shape = g.op("Shape", &[&self.positions]);
        let at = g.ints(&[], &[1]);
        let n = g.gather(&shape, &at, 0);
        let (zero, one) = (g.ints(&[], &[0]), g.ints(&[], &[1]));
        let range = g.op("Range", &[&zero, &n, &one]);
        let (rows, columns) = (g.unsqueeze(&range, 1), g.unsqueeze(&range, 0));
        g.op("Equal", &[&rows, &columns])
    }

    /// N as a number of single precision, [1].
    pub(super) fn agents(&self, g: &mut Builder) -> Value {
        let shape = g.op("Shape", &[&self.positions]);
        let at = g.ints(&[1], &[1]);
        let n = g.gather(&shape, &at, 0);
        g.cast_float(&n)
    }

    /// The k nearest bodies [B, N, k, width], and 1 for those that exist, [B, N, k, 1].
    pub(super) fn neighbours(&self, g: &mut Builder) -> (Value, Value) {
        let (o, k) = (self.o, self.executor.neighbours);
        let all = |g: &mut Builder, agents: &str, balls: Option<&Value>| match balls {
            Some(balls) => g.concat(1, &[agents, balls]),
            None => agents.to_owned(),
        };
        let p = all(g, &self.positions, self.balls.as_ref().map(|(p, _)| p));
        let v = all(g, &self.velocities, self.balls.as_ref().map(|(_, v)| v));
        let (wide, tall) = (g.unsqueeze(&p, 1), g.unsqueeze(&self.positions, 2));
        let offset = g.sub(&wide, &tall);
        let square = g.mul(&offset, &offset);
        let square = g.sum(&square, -1, false);
        let mut hidden = self.diagonal(g);
        if self.balls.is_some() {
            // An agent's own ball has its index.
            let (both, zero) = (g.cast_float(&hidden), g.scalar(0.5));
            let both = g.concat(1, &[&both, &both]);
            hidden = g.op("Greater", &[&both, &zero]);
        }
        if let (Some(out), Some(state)) = (o.out, &self.agent_state) {
            let at = g.ints(&[1], &[out as i64]);
            let (flag, zero) = (g.gather(state, &at, -1), g.scalar(0.0));
            let flag = g.op("Greater", &[&flag, &zero]);
            let across = g.transpose(&flag, &[0, 2, 1]);
            let either = g.op("Or", &[&flag, &across]);
            hidden = g.op("Or", &[&hidden, &either]);
        }
        let reach = g.scalar(o.sensing_radius * o.sensing_radius);
        let far = g.op("Greater", &[&square, &reach]);
        let unseen = g.op("Or", &[&far, &hidden]);
        let never = g.scalar(FAR);
        let square = g.choose(&unseen, &never, &square);
        // There are k places whatever the team size.
        let pads = g.ints(&[6], &[0, 0, 0, 0, 0, k as i64]);
        let square = g.op("Pad", &[&square, &pads, &never]);
        let (nearest, index) = g.smallest(&square, k);
        let end = g.scalar(FAR / 2.0);
        let exists = g.op("Less", &[&nearest, &end]);
        let first = g.ints(&[], &[0]);
        let index = g.choose(&exists, &index, &first);
        let exists = g.cast_float(&exists);
        let exists = g.unsqueeze(&exists, -1);
        let (p, v) = (g.pick(&p, &index, 1), g.pick(&v, &index, 1));
        let (offset, own) = (g.sub(&p, &tall), g.unsqueeze(&self.velocities, 2));
        let velocity = g.sub(&v, &own);
        let distance = g.length(&offset);
        let (offset, velocity) = (self.see(g, &offset, true), self.see(g, &velocity, true));
        let contact = g.scalar(o.contact_radius);
        let closeness = |g: &mut Builder, d: &str| {
            let close = Self::faded(g, &contact, d, 1e-6);
            g.at_most(&close, 2.0)
        };
        let mut parts = vec![offset.clone(), g.over(&velocity, o.speed), closeness(g, &distance)];
        if o.encounters {
            let (meeting, moving) = (g.mul(&offset, &velocity), g.mul(&velocity, &velocity));
            let (meeting, moving) = (g.sum(&meeting, -1, true), g.sum(&moving, -1, true));
            let (closing, moving) = (g.op("Neg", &[&meeting]), g.at_least(&moving, 1e-4));
            let time = g.div(&closing, &moving);
            let time = g.clip(&time, 0.0, 2.0);
            let way = g.mul(&velocity, &time);
            let miss = g.add(&offset, &way);
            let twice = g.times(&miss, 2.0);
            parts.push(g.clip(&twice, -1.0, 1.0));
            parts.push(g.over(&time, 2.0));
            let nearest = g.length(&miss);
            parts.push(closeness(g, &nearest));
        }
        if self.balls.is_some() {
            let shape = g.op("Shape", &[&self.positions]);
            let at = g.ints(&[1], &[1]);
            let n = g.gather(&shape, &at, 0);
            let ball = g.op("GreaterOrEqual", &[&index, &n]);
            let ball = g.cast_float(&ball);
            parts.push(g.unsqueeze(&ball, -1));
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        (g.concat(-1, &parts), exists)
    }

    /// Node features [B, N, width] and pair features [B, N, 2D].
    pub(super) fn team(&self, g: &mut Builder) -> (Value, Value) {
        let (p, v) = (g.div(&self.positions, &self.half_side), g.over(&self.velocities, self.o.speed));
        let mut parts = vec![p, v.clone()];
        parts.extend(self.agent_state.clone());
        if let Some((balls, _)) = &self.balls {
            let to = g.sub(balls, &self.positions);
            let d = g.length(&to);
            parts.push(Self::squashed(g, &to, &d));
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        (g.concat(-1, &parts), g.concat(-1, &[&self.positions, &v]))
    }

    /// The flat observation vector [B, N, V]: the team size is fixed.
    pub(super) fn vector(&self, g: &mut Builder) -> Value {
        let (n, p) = (self.task.agents, &self.positions);
        let mut parts = vec![g.over(&self.velocities, self.o.speed), g.div(p, &self.half_side)];
        parts.extend(self.agent_state.clone());
        let tall = g.unsqueeze(p, 2);
        let put = |g: &mut Builder, points: &str, count: usize| {
            let mut to = g.sub(points, &tall);
            if self.executor.nearest_first && count > 1 {
                let d = g.length(&to);
                let d = g.squeeze(&d, -1);
                let (_, order) = g.smallest(&d, count);
                to = g.pick(&to, &order, 2);
            }
            let to = g.div(&to, &self.half_side);
            g.reshape(&to, &[0, 0, -1])
        };
        match self.executor.observes {
            Observes::Landmarks => {
                for points in [&self.goals].into_iter().chain(self.balls.as_ref().map(|(balls, _)| balls)) {
                    let points = g.unsqueeze(points, 1);
                    parts.push(put(g, &points, n));
                }
            }
            Observes::Goals => {
                for target in self.balls.as_ref().map(|(balls, _)| balls).into_iter().chain([&self.goals]) {
                    let to = g.sub(target, p);
                    parts.push(g.div(&to, &self.half_side));
                }
            }
        }
        if n > 1 {
            let others: Vec<i64> = (0..n).flat_map(|i| (0..n).filter(move |&j| j != i)).map(|j| j as i64).collect();
            let others = g.ints(&[n, n - 1], &others);
            let points = g.gather(p, &others, 1);
            parts.push(put(g, &points, n - 1));
        }
        if self.executor.agent_index {
            let one_hot: Vec<f32> = (0..n * n).map(|at| f32::from(u8::from(at / n == at % n))).collect();
            let one_hot = g.floats(&[1, n, n], &one_hot);
            // As often as there are teams.
            let at = g.ints(&[1], &[0]);
            let (zeros, first) = (g.times(p, 0.0), at);
            let zeros = g.gather(&zeros, &first, -1);
            parts.push(g.add(&one_hot, &zeros));
        }
        let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
        g.concat(-1, &parts)
    }
}
