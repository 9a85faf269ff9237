use super::*;
use candle_core::{Device, Tensor};

/// Two steps before the last, one episode, two agents.
#[test]
fn subgoals_and_intrinsic_rewards_match_hand_computed_values() {
    // Scores ½ Q_i + ½ Q_tot / 2: agent 0: 0.5 + 1 = 1.5, 1 + 0.25 = 1.25, 2 + 0 = 2; agent 1: 2 + 1 = 3, 2.75 + 0.25 = 3, 0.
    let (individual, team) = ([1.0, 4.0, 2.0, 5.5, 4.0, 0.0, 99.0, 99.0], [4.0, 1.0, 0.0, 99.0]);
    let sizes = (3, 1, 2);
    // The first of equals; the state after the last action is no step of the episode.
    assert_eq!(choose(0.5, sizes, &individual, &team), [2, 0]);
    // The agent's own value alone, and the team's alone.
    assert_eq!(choose(1.0, sizes, &individual, &team), [2, 1]);
    assert_eq!(choose(0.0, sizes, &individual, &team), [0, 0]);

    let images = [[0.0f32, 0.0], [3.0, 4.0], [3.0, 4.0], [3.0, 0.0], [0.0, 8.0], [3.0, 4.0]];
    let images = Tensor::new(&images, &Device::Cpu).unwrap();
    let config = MaserConfig { lambda: 0.5, ..MaserConfig::default() };
    let subgoals = Subgoals::find(&config, sizes, &individual, &team, images).unwrap();
    // Agent 0 to (0, 8), agent 1 to (3, 4).
    assert_eq!(subgoals.plain, [8.0, 0.0, 5.0, 4.0, 0.0, 0.0]);
    let mut rewards = [1.0, 1.0, 1.0];
    subgoals.reward(&config, &mut rewards);
    assert_eq!(rewards, [1.0 - 0.5 * 4.0, 1.0 - 0.5 * 4.5, 1.0]);
}

#[test]
fn shares_add_up_and_cosines_are_of_the_angle() {
    let two = shares(&[0.0, libm::logf(3.0)]);
    assert!((two[0] - 0.25).abs() < 1e-6 && (two[1] - 0.75).abs() < 1e-6);
    assert_eq!(shares(&[1000.0; 4]), [0.25; 4]);
    assert_eq!(cosine(&[2.0, 0.0], &[0.0, 3.0]), 0.0);
    assert!(
        (cosine(&[1.0, 2.0], &[2.0, 4.0]) - 1.0).abs() < 1e-6
            && (cosine(&[1.0, 2.0], &[-1.0, -2.0]) + 1.0).abs() < 1e-6
    );
    assert_eq!(cosine(&[0.0, 0.0], &[1.0, 1.0]), 0.0);
}
