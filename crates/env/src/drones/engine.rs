//! The rapier world of one episode: N drones with cylinder colliders above a ground plane.

use super::model::Craft;
use rapier3d::prelude::*;

/// Radius of a drone's collision cylinder, m.
pub(crate) const CYLINDER_RADIUS: f32 = 0.06;
/// Half its height, m; its axis is body z.
pub(crate) const CYLINDER_HALF_HEIGHT: f32 = 0.0125;
/// No point of the cylinder is farther from the centre than this, m (√(0.06² + 0.0125²), rounded up).
pub(crate) const REACH: f32 = 0.0613;

/// Distance at which rapier begins to look at a contact, m.
pub(crate) const FORESIGHT: f32 = 0.002;

/// The mass properties of a drone as rapier is told them.
fn mass_properties(craft: &Craft) -> MassProperties {
    let [x, y, z] = craft.inertia;
    MassProperties::new(Vector::ZERO, craft.mass as f32, Vector::new(x as f32, y as f32, z as f32))
}

/// From the collider, whose axis is y, to the body, whose axis is z: a quarter turn about x.
pub(crate) fn upright() -> Pose {
    let half = std::f32::consts::FRAC_1_SQRT_2;
    Pose::from_parts(Vector::ZERO, Rotation::from_xyzw(half, 0.0, 0.0, half))
}

/// How rapier steps the drones.
///
/// One solver iteration: rapier divides a step by that number, and one undivided step is the reference's semi-implicit
/// Euler. No damping (the reference's is an explicit force), no gyroscopic correction (the reference's explicit term is
/// a torque), no sleeping (a hovering drone would), no continuous collision detection and little foresight: rapier's
/// contact points of two cylinders are approximate, so contacts foreseen from afar act millimetres before the shapes
/// meet. What happens within a step is found by [`super::world::World::judge`] instead.
pub(crate) fn parameters(dt: f32, most_speed: f32) -> IntegrationParameters {
    IntegrationParameters {
        dt,
        num_solver_iterations: 1,
        max_ccd_substeps: 0,
        normalized_max_linear_velocity: most_speed,
        normalized_prediction_distance: FORESIGHT,
        // Drones that overlap after a fast step part gently.
        normalized_max_corrective_velocity: 0.5,
        // The default of 5 mm is a fifth of a drone's height.
        normalized_allowed_linear_error: 0.0005,
        // Both reuse or merge contacts over 5 cm, the radius of a drone.
        contact_recycling: false,
        contact_clustering: false,
        ..IntegrationParameters::default()
    }
}

/// Where a body is and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Motion {
    pub(crate) pose: Pose,
    pub(crate) linvel: Vector,
    pub(crate) angvel: Vector,
}

impl Motion {
    pub(crate) fn is_finite(&self) -> bool {
        self.pose.is_finite() && self.linvel.is_finite() && self.angvel.is_finite()
    }
}

/// What a drone touched in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Touch {
    pub(crate) drone: bool,
    pub(crate) ground: bool,
}

pub(crate) struct Engine {
    world: PhysicsWorld,
    bodies: Vec<RigidBodyHandle>,
    colliders: Vec<ColliderHandle>,
}

impl Engine {
    /// Drones at given places, no forces.
    pub(crate) fn new(motions: impl Iterator<Item = Motion>, parameters: IntegrationParameters, craft: &Craft) -> Self {
        let properties = mass_properties(craft);
        let mut world = PhysicsWorld::new();
        world.gravity = Vector::new(0.0, 0.0, -(craft.gravity as f32));
        world.integration_parameters = parameters;
        world.insert_collider(ColliderBuilder::new(SharedShape::halfspace(Vector::Z)), None);
        let (mut bodies, mut colliders) = (Vec::new(), Vec::new());
        for motion in motions {
            let body = RigidBodyBuilder::dynamic()
                .pose(motion.pose)
                .linvel(motion.linvel)
                .angvel(motion.angvel)
                .additional_mass_properties(properties)
                .gyroscopic_forces_enabled(false)
                .can_sleep(false);
            let collider =
                ColliderBuilder::cylinder(CYLINDER_HALF_HEIGHT, CYLINDER_RADIUS).position(upright()).density(0.0);
            let (body, collider) = world.insert(body, collider);
            bodies.push(body);
            colliders.push(collider);
        }
        Self { world, bodies, colliders }
    }

    /// The mass properties of a drone as rapier uses them: it finds the principal axes itself, and another order or sign
    /// of them gives other roundings.
    pub(crate) fn properties(craft: &Craft, parameters: IntegrationParameters) -> MassProperties {
        let alone = Motion {
            pose: Pose::from_parts(Vector::new(0.0, 0.0, 10.0), Rotation::IDENTITY),
            linvel: Vector::ZERO,
            angvel: Vector::ZERO,
        };
        let mut engine = Self::new(std::iter::once(alone), parameters, craft);
        engine.step();
        engine.world.bodies[engine.bodies[0]].mass_properties().local_mprops
    }

    /// Moves a drone, if it is not there already.
    pub(crate) fn place(&mut self, drone: usize, motion: &Motion) {
        let body = &mut self.world.bodies[self.bodies[drone]];
        if *body.position() != motion.pose {
            body.set_position(motion.pose, false);
        }
        if body.linvel() != motion.linvel {
            body.set_linvel(motion.linvel, false);
        }
        if body.angvel() != motion.angvel {
            body.set_angvel(motion.angvel, false);
        }
    }

    /// Turns a drone into a part of the scenery.
    pub(crate) fn fix(&mut self, drone: usize) {
        self.world.bodies[self.bodies[drone]].set_body_type(RigidBodyType::Fixed, false);
    }

    /// The force and the torque of the next step.
    pub(crate) fn load(&mut self, drone: usize, force: Vector, torque: Vector) {
        let body = &mut self.world.bodies[self.bodies[drone]];
        // rapier keeps forces from step to step.
        body.reset_forces(false);
        body.reset_torques(false);
        body.add_force(force, false);
        body.add_torque(torque, false);
    }

    pub(crate) fn step(&mut self) {
        self.world.step();
    }

    pub(crate) fn motion(&self, drone: usize) -> Motion {
        let body = &self.world.bodies[self.bodies[drone]];
        Motion { pose: *body.position(), linvel: body.linvel(), angvel: body.angvel() }
    }

    /// Whether rapier has switched a drone off because its state was not finite.
    pub(crate) fn is_quarantined(&self, drone: usize) -> bool {
        !self.world.bodies[self.bodies[drone]].is_enabled()
    }

    /// Marks what pushed each drone during the last step.
    pub(crate) fn mark_contacts(&self, touches: &mut [Touch]) {
        let pushed = |pair: &&ContactPair| {
            let points = pair.manifolds().iter().flat_map(|manifold| &manifold.points);
            points.map(|point| point.data.impulse).any(|impulse| impulse > 0.0)
        };
        let drone = |collider: ColliderHandle| self.colliders.iter().position(|&own| own == collider);
        for pair in self.world.narrow_phase.contact_pairs().filter(pushed) {
            match (drone(pair.collider1), drone(pair.collider2)) {
                (Some(a), Some(b)) => (touches[a].drone, touches[b].drone) = (true, true),
                (Some(a), None) | (None, Some(a)) => touches[a].ground = true,
                (None, None) => {}
            }
        }
    }
}
