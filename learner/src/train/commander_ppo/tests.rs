#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;
use magex_core::config::CommanderPolicy;
use magex_core::ids::Mode;
use magex_core::task::Spawn;

/// N agents and G goals, uniform in the unit square.
fn points(n: usize, g: usize, k: u32) -> (Vec<f32>, Vec<f32>) {
    let mut stream = Key::new(3, Purpose::Instances, &[n as u32, g as u32, k]).stream();
    let mut draw = |count: usize| (0..2 * count).map(|_| stream.uniform32()).collect::<Vec<f32>>();
    (draw(n), draw(g))
}

fn ppo() -> CommanderPpo {
    let config = CommanderConfig { learning_rate: 3e-3, ..CommanderConfig::default() };
    CommanderPpo::new(&config, &TaskConfig::simple_spread(20, Spawn::Uniform), 1)
}

fn lessons(ppo: &CommanderPpo, sizes: &[(usize, usize)]) -> Vec<Lesson> {
    let commander = ppo.commander(&ppo.init().unwrap()).unwrap();
    let lesson = |(k, &(n, g)): (usize, &(usize, usize))| {
        let (agents, goals) = points(n, g, k as u32);
        let team = Team { agents: &agents, goals: &goals, dims: 2 };
        let solver = Commander::classical(CommanderPolicy::Exact).unwrap();
        let exact = solver.assign(&team, Mode::Greedy, &mut Key::new(0, Purpose::Commander, &[]).stream()).unwrap();
        Lesson::new(&commander, &team, &exact.goals).unwrap()
    };
    sizes.iter().enumerate().map(lesson).collect()
}

/// Mean log-probability of the lessons' picks.
fn mean_log_prob(ppo: &CommanderPpo, network: &Network, lessons: &[Lesson]) -> f64 {
    let commander = ppo.commander(network).unwrap();
    let of = |lesson: &Lesson| {
        let both = commander.pick_log_probs(&[&lesson.instance], &[&lesson.picks]).unwrap();
        f64::from(both.get(0).unwrap().mean_all().unwrap().to_scalar::<f32>().unwrap())
    };
    lessons.iter().map(of).sum::<f64>() / lessons.len() as f64
}

#[test]
fn a_sampled_decision_has_the_same_likelihood_when_it_is_looked_at_again() {
    let ppo = ppo();
    let commander = ppo.commander(&ppo.init().unwrap()).unwrap();
    for (n, g) in [(1, 1), (2, 2), (7, 7), (50, 50), (5, 40), (40, 5), (17, 16), (1, 9), (9, 1)] {
        let (agents, goals) = points(n, g, 0);
        let team = Team { agents: &agents, goals: &goals, dims: 2 };
        let mut stream = Key::new(1, Purpose::Commander, &[n as u32, g as u32]).stream();
        let decision = commander.assign(&team, Mode::Sampled, &mut stream).unwrap();
        let instance = commander.instance(&team).unwrap();
        let picks = instance.picks_of(&decision.goals).unwrap();
        assert_eq!(picks.len(), n.min(g));
        let both = commander.pick_log_probs(&[&instance], &[&picks]).unwrap();
        let again = both.get(0).unwrap().to_vec1::<f32>().unwrap();
        // Bit for bit: the first importance ratio is exactly 1.
        assert_eq!(again.iter().sum::<f32>(), decision.log_prob, "{n} agents, {g} goals");
        let probabilities = picks.iter().zip(&again).map(|(pick, log_prob)| {
            let agent = if n > g { pick.column } else { pick.row };
            (decision.probabilities[agent as usize], libm::expf(*log_prob))
        });
        probabilities.for_each(|(told, found)| assert_eq!(told, found));
    }
}

#[test]
fn agents_without_a_goal_cost_nothing() {
    let team = Team { agents: &[0.0, 0.0, 3.0, 4.0, 9.0, 9.0], goals: &[0.0, 0.0], dims: 2 };
    assert_eq!(cost(&team, &[u32::MAX, 0, u32::MAX]), 5.0);
}

#[test]
fn goals_that_occur_twice_have_no_picks() {
    let ppo = ppo();
    let commander = ppo.commander(&ppo.init().unwrap()).unwrap();
    let (agents, goals) = points(4, 4, 0);
    let instance = commander.instance(&Team { agents: &agents, goals: &goals, dims: 2 }).unwrap();
    assert!(instance.picks_of(&[0, 1, 2, 3]).is_some());
    for wrong in [&[0, 1, 2, 2][..], &[0, 1, 2, 4], &[0, 1, 2], &[0, 1, 2, u32::MAX]] {
        assert_eq!(instance.picks_of(wrong), None, "{wrong:?}");
    }
}

#[test]
fn the_gradient_of_the_cross_entropy_is_its_slope() {
    let ppo = ppo();
    let lessons = lessons(&ppo, &[(6, 6), (5, 12), (20, 20)]);
    let mut network = ppo.init().unwrap();
    // Far enough from the start for every layer to matter.
    let mut stream = Key::new(9, Purpose::Init, &[]).stream();
    network.params.values.iter_mut().for_each(|x| *x += 0.1 * stream.normal() as f32);
    let (commander, variables) = ppo.differentiable(&network).unwrap();
    let instances: Vec<&Instance> = lessons.iter().map(|l| &l.instance).collect();
    let picks: Vec<&[Pick]> = lessons.iter().map(|l| &*l.picks).collect();
    let both = commander.pick_log_probs(&instances, &picks).unwrap();
    let value =
        |both: &Tensor| both.get(0).unwrap().sum_all().unwrap() + (both.get(1).unwrap().sum_all().unwrap() * 0.3);
    let gradients = value(&both).unwrap().backward().unwrap();
    let number = |network: &Network| {
        let both = ppo.commander(network).unwrap().pick_log_probs(&instances, &picks).unwrap();
        f64::from(value(&both).unwrap().to_scalar::<f32>().unwrap())
    };
    for (entry, variable) in network.params.entries.clone().iter().zip(&variables) {
        let gradient = gradients.get(variable).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let place = (0..gradient.len()).max_by(|&a, &b| gradient[a].abs().total_cmp(&gradient[b].abs())).unwrap();
        let slope = |step: f32| {
            let mut moved = network.clone();
            moved.params.values[entry.start + place] += step;
            number(&moved)
        };
        let slope = (slope(2e-3) - slope(-2e-3)) / 4e-3;
        let error = (slope - f64::from(gradient[place])).abs();
        assert!(error < 0.05 * slope.abs() + 0.02, "{}: {slope} and {}", entry.name, gradient[place]);
    }
}

#[test]
fn imitation_makes_the_exact_assignment_likelier_also_on_teams_of_another_size() {
    let ppo = ppo();
    let sizes: Vec<(usize, usize)> = (0..48).map(|k| (2 + k, 2 + k + k % 3)).collect();
    let (seen, unseen) = (lessons(&ppo, &sizes), lessons(&ppo, &[(200, 200), (199, 200), (3, 3)]));
    let mut network = ppo.init().unwrap();
    let before = mean_log_prob(&ppo, &network, &unseen);
    let first = ppo.imitate(&mut network, &seen, 1.0).unwrap();
    let losses: Vec<f64> = (0..40).map(|_| ppo.imitate(&mut network, &seen, 1.0).unwrap()).collect();
    let (last, after) = (losses[39], mean_log_prob(&ppo, &network, &unseen));
    assert!(last < 0.9 * first, "{first} became {last}");
    assert!(after > 0.9 * before, "{before} became {after}");
}
