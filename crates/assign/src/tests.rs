use crate::Result;
use crate::duals::sinkhorn_duals;
use crate::*;
use magex_core::rng::{Key, Purpose, Stream};
use pathfinding::kuhn_munkres::kuhn_munkres_min;
use pathfinding::matrix::Matrix;
use proptest::prelude::*;

fn stream(index: u32) -> Stream {
    Key::new(5, Purpose::Bench, &[index]).stream()
}

/// n agents and n goals, uniform in the unit square: (agents `[n, 2]`, goals `[n, 2]`).
fn uniform_points(n: usize, index: u32) -> (Vec<f32>, Vec<f32>) {
    let mut stream = Key::new(0, Purpose::Bench, &[n as u32, index]).stream();
    let mut points = || (0..2 * n).map(|_| stream.uniform32()).collect();
    (points(), points())
}

fn distances(agents: &[f32], goals: &[f32], dims: usize) -> Result<Vec<f64>> {
    let mut cost = Vec::new();
    distances_into(agents, goals, dims, &mut cost)?;
    Ok(cost)
}

fn exact(cost: &[f64], rows: usize, cols: usize) -> Result<Assignment> {
    Solver::default().solve(cost, rows, cols)
}

/// The largest cost of a pair; −∞ without pairs.
fn largest_of((_, cols, cost): &Problem, answer: &Assignment) -> f64 {
    answer.pairs().map(|(row, col)| cost[row * cols + col]).fold(f64::NEG_INFINITY, f64::max)
}

/// Shape, entries.
type Problem = (usize, usize, Vec<f64>);

/// Visits every way to give each of `short` members another one of `long`.
fn every_matching(short: usize, long: usize, chosen: &mut Vec<usize>, visit: &mut impl FnMut(&[usize])) {
    if chosen.len() == short {
        return visit(chosen);
    }
    for next in 0..long {
        if !chosen.contains(&next) {
            chosen.push(next);
            every_matching(short, long, chosen, visit);
            chosen.pop();
        }
    }
}

/// (smallest sum, smallest largest cost, smallest sum among those with it) over all matchings.
fn brute_force((rows, cols, cost): &Problem) -> (f64, f64, f64) {
    let (mut best, mut largest, mut within) = (f64::INFINITY, f64::INFINITY, f64::INFINITY);
    every_matching(*rows.min(cols), *rows.max(cols), &mut Vec::new(), &mut |chosen| {
        let entry = |(a, &b): (usize, &usize)| if rows <= cols { cost[a * cols + b] } else { cost[b * cols + a] };
        let entries = || chosen.iter().enumerate().map(entry);
        let sum = compensated_sum(entries());
        let top = entries().fold(f64::NEG_INFINITY, f64::max);
        best = best.min(sum);
        if top < largest || (top == largest && sum < within) {
            (largest, within) = (top, sum);
        }
    });
    (best, largest, within)
}

fn close(a: f64, b: f64, cost: &[f64]) -> bool {
    let scale = cost.iter().fold(0.0f64, |scale, c| scale.max(c.abs()));
    (a - b).abs() <= 1e-12 * scale.max(b.abs())
}

fn check_matching((rows, cols, cost): &Problem, answer: &Assignment) {
    assert_eq!(answer.col_of_row.len(), *rows);
    let mut seen: Vec<usize> = answer.pairs().map(|(_, col)| col).collect();
    assert_eq!(seen.len(), *rows.min(cols), "as many pairs as the shorter side has members");
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen.len(), *rows.min(cols), "no column twice");
    assert!(seen.iter().all(|col| col < cols));
    assert_eq!(answer.cost, cost_of(cost, *cols, &answer.col_of_row));
}

/// Kuhn–Munkres of another author on whole numbers.
fn second_opinion(rows: usize, cols: usize, cost: &[i128]) -> i128 {
    let matrix = Matrix::from_vec(rows, cols, cost.to_vec()).unwrap();
    let matrix = if rows <= cols { matrix } else { matrix.transposed() };
    kuhn_munkres_min(&matrix).0
}

/// The kinds of numbers that break solvers: few values, halves, negative, huge, tiny.
fn entry() -> impl Strategy<Value = f64> {
    prop_oneof![
        (0i32..3).prop_map(f64::from),
        -1.0f64..1.0,
        Just(0.1),
        (-4i32..4).prop_map(|k| f64::from(k) * 1e12),
        (0u32..9).prop_map(|k| f64::from(k) * 1e-9),
    ]
}

#[test]
fn a_solver_that_is_told_to_stop_stops_and_can_be_used_again() {
    let (agents, goals) = uniform_points(60, 1);
    let cost = distances(&agents, &goals, 2).unwrap();
    let mut solver = Solver::default();
    assert_eq!(solver.solve_allowed(&cost, 60, 60, &|| false), Err(AssignError::Interrupted));
    let stopped = BottleneckSolver::default().solve_switching(&cost, 60, 60, &Switching::default(), &|| false);
    assert_eq!(stopped, Err(AssignError::Interrupted));
    let large = vec![1.0; 300 * 300];
    assert_eq!(greedy(&large, 300, 300, &|| false), Err(AssignError::Interrupted));
    let mut banned = cost.clone();
    banned[7] = f64::INFINITY;
    let stopped = random::random_allowed(&banned, 60, 60, &mut stream(1), &|| false);
    assert_eq!(stopped, Err(AssignError::Interrupted));
    assert_eq!(solver.solve_allowed(&cost, 60, 60, &|| true), exact(&cost, 60, 60));
    assert!(solver.solve_allowed(&[f64::NEG_INFINITY], 1, 1, &|| true).is_err());
    assert!(solver.solve_allowed(&[f64::NAN], 1, 1, &|| true).is_err());
    assert_eq!(solver.solve_allowed(&[f64::INFINITY; 2], 2, 1, &|| true).unwrap().col_of_row, [UNASSIGNED; 2]);
}

#[test]
fn greedy_takes_the_cheapest_pair_also_where_it_sorts_in_pieces() {
    let (rows, cols) = (300, 520);
    let mut chance = stream(9);
    // Whole numbers: many ties.
    let cost: Vec<f64> = (0..rows * cols).map(|_| f64::from(chance.below(5000))).collect();
    let mut order: Vec<usize> = (0..rows * cols).collect();
    order.sort_by(|&a, &b| cost[a].total_cmp(&cost[b]).then(a.cmp(&b)));
    let (mut expected, mut taken) = (vec![UNASSIGNED; rows], vec![false; cols]);
    for place in order {
        let (row, col) = (place / cols, place % cols);
        if expected[row] == UNASSIGNED && !taken[col] {
            (expected[row], taken[col]) = (col as u32, true);
        }
    }
    assert_eq!(greedy(&cost, rows, cols, &|| true).unwrap().col_of_row, expected);
}

fn small_problem() -> impl Strategy<Value = Problem> {
    let entries = |rows: usize, cols: usize| prop::collection::vec(entry(), rows * cols);
    let mixed = (1usize..=6, 1usize..=6).prop_flat_map(move |(r, c)| (Just(r), Just(c), entries(r, c)));
    let plain =
        (1usize..=7, 1usize..=7).prop_flat_map(|(r, c)| (Just(r), Just(c), prop::collection::vec(0.0f64..1.0, r * c)));
    prop_oneof![3 => mixed, 1 => plain]
}

/// (pairs, smallest sum, smallest largest cost, smallest sum among those with it) over the largest matchings without
/// forbidden pairs.
fn brute_force_allowed((rows, cols, cost): &Problem) -> (usize, f64, f64, f64) {
    let mut best = (0, 0.0, f64::NEG_INFINITY, 0.0);
    every_matching(*rows.min(cols), *rows.max(cols), &mut Vec::new(), &mut |chosen| {
        let entry = |(a, &b): (usize, &usize)| if rows <= cols { cost[a * cols + b] } else { cost[b * cols + a] };
        let entries = || chosen.iter().enumerate().map(entry).filter(|c| c.is_finite());
        let (pairs, sum) = (entries().count(), compensated_sum(entries()));
        let top = entries().fold(f64::NEG_INFINITY, f64::max);
        if pairs > best.0 {
            best = (pairs, sum, top, sum);
        } else if pairs == best.0 {
            best.1 = sum.min(best.1);
            if top < best.2 || (top == best.2 && sum < best.3) {
                (best.2, best.3) = (top, sum);
            }
        }
    });
    best
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(400) })]

    #[test]
    fn forbidden_pairs_agree_with_brute_force(
        (rows, cols, mut cost) in small_problem(), share in 0u32..=10, seed in 0u32..1000
    ) {
        let mut chance = stream(seed);
        cost.iter_mut().filter(|_| chance.below(10) < share).for_each(|c| *c = f64::INFINITY);
        let finite: Vec<f64> = cost.iter().copied().filter(|c| c.is_finite()).collect();
        let problem = (rows, cols, cost);
        let (pairs, sum, largest, within) = brute_force_allowed(&problem);
        let cost = &problem.2;
        let allowed = |a: &Assignment| a.pairs().all(|(row, col)| cost[row * cols + col].is_finite());
        let answer = Solver::default().solve_allowed(cost, rows, cols, &|| true).unwrap();
        prop_assert!(allowed(&answer) && answer.pairs().count() == pairs);
        prop_assert!(close(answer.cost, sum, &finite), "{} instead of {sum}", answer.cost);
        let answer = BottleneckSolver::default().solve_switching(cost, rows, cols, &Switching::default(), &|| true).unwrap();
        prop_assert!(allowed(&answer) && answer.pairs().count() == pairs);
        prop_assert_eq!(largest_of(&problem, &answer), largest);
        prop_assert!(close(answer.cost, within, &finite), "{} not {within}", answer.cost);
        let answer = greedy(cost, rows, cols, &|| true).unwrap();
        prop_assert!(allowed(&answer) && 2 * answer.pairs().count() >= pairs);
        let col_of_row = random::random_allowed(cost, rows, cols, &mut chance, &|| true).unwrap();
        let answer = Assignment { cost: 0.0, col_of_row };
        prop_assert!(allowed(&answer) && answer.pairs().count() == pairs);
    }

    #[test]
    fn small_problems_agree_with_brute_force(problem in small_problem()) {
        let (rows, cols, cost) = &problem;
        let (sum, largest, within) = brute_force(&problem);
        let answer = exact(cost, *rows, *cols).unwrap();
        check_matching(&problem, &answer);
        prop_assert!(close(answer.cost, sum, cost), "{} instead of {sum}", answer.cost);
        let answer = BottleneckSolver::default().solve_switching(cost, *rows, *cols, &Switching::default(), &|| true).unwrap();
        check_matching(&problem, &answer);
        prop_assert_eq!(largest_of(&problem, &answer), largest);
        prop_assert!(close(answer.cost, within, cost), "{} instead of {within}", answer.cost);
    }

    #[test]
    fn whole_numbers_agree_with_kuhn_munkres(
        (rows, cols, cost) in (1usize..40, 1usize..40, prop_oneof![Just(3i64), Just(50), Just(1_000_000_000_000)])
            .prop_flat_map(|(r, c, top)| (Just(r), Just(c), prop::collection::vec(-top..=top, r * c)))
    ) {
        let whole: Vec<i128> = cost.iter().map(|&c| i128::from(c)).collect();
        let cost: Vec<f64> = cost.iter().map(|&c| c as f64).collect();
        let answer = exact(&cost, rows, cols).unwrap();
        prop_assert_eq!(answer.cost as i128, second_opinion(rows, cols, &whole));
        check_matching(&(rows, cols, cost), &answer);
    }

    #[test]
    fn baselines_are_matchings_and_never_beat_the_optimum(problem in small_problem(), seed in 0u32..1000) {
        let (rows, cols, cost) = &problem;
        let optimum = exact(cost, *rows, *cols).unwrap().cost;
        let scale = 1e-12 * cost.iter().fold(0.0f64, |scale, c| scale.max(c.abs()));
        let answer = greedy(cost, *rows, *cols, &|| true).unwrap();
        check_matching(&problem, &answer);
        prop_assert!(answer.cost >= optimum - scale);
        let col_of_row = random::random(*rows, *cols, &mut stream(seed)).unwrap();
        let cost = cost_of(cost, *cols, &col_of_row);
        check_matching(&problem, &Assignment { col_of_row, cost });
        prop_assert!(cost >= optimum - scale);
    }
}

#[test]
fn twelve_decades_in_one_matrix_keep_the_optimum_to_nine_digits() {
    for seed in 0..200 {
        let mut stream = stream(seed);
        let (rows, cols) = (1 + stream.below(30) as usize, 1 + stream.below(30) as usize);
        // Decimal numbers 1e-6 .. 1e6 as whole multiples of 1e-8, so that the second opinion is exact.
        let whole: Vec<i128> =
            (0..rows * cols).map(|_| i128::from(1 + stream.below(9999)) * 10i128.pow(stream.below(11))).collect();
        let cost: Vec<f64> = whole.iter().map(|&c| c as f64 / 1e8).collect();
        let expected = second_opinion(rows, cols, &whole) as f64 / 1e8;
        let found = exact(&cost, rows, cols).unwrap().cost;
        assert!((found / expected - 1.0).abs() <= 1e-9, "seed {seed}: {found} instead of {expected}");
    }
}

#[test]
fn large_euclidean_problems_agree_with_kuhn_munkres() {
    for (rows, cols) in [(100, 100), (200, 200), (120, 200), (200, 60)] {
        let (agents, _) = uniform_points(rows, 1);
        let (goals, _) = uniform_points(cols, 2);
        let cost = distances(&agents, &goals, 2).unwrap();
        let whole: Vec<i128> = cost.iter().map(|&c| (c * 1e15) as i128).collect();
        let expected = second_opinion(rows, cols, &whole) as f64 / 1e15;
        let found = exact(&cost, rows, cols).unwrap().cost;
        assert!((found / expected - 1.0).abs() < 1e-12, "{rows} x {cols}: {found} instead of {expected}");
    }
}

#[test]
fn ties_are_broken_the_same_way_every_time_and_nothing_is_remembered() {
    let mut solver = Solver::default();
    for (index, (rows, cols)) in
        [(5, 5), (50, 50), (3, 9), (64, 20), (20, 64), (1, 1), (50, 50)].into_iter().enumerate()
    {
        for values in [1, 2, 3] {
            let mut stream = stream(index as u32);
            let cost: Vec<f64> = (0..rows * cols).map(|_| f64::from(stream.below(values))).collect();
            let fresh = exact(&cost, rows, cols).unwrap();
            assert_eq!(solver.solve(&cost, rows, cols).unwrap(), fresh);
            assert_eq!(solver.solve(&cost, rows, cols).unwrap(), fresh);
        }
    }
}

#[test]
fn shortlists_change_nothing_not_even_how_ties_are_broken() {
    let (mut with, mut without) = (Solver::default(), Solver::default());
    (with.lists_from, without.lists_from) = (Some(150), Some(usize::MAX));
    for (index, (rows, cols)) in [(150, 150), (300, 300), (200, 400), (400, 180)].into_iter().enumerate() {
        let mut stream = stream(index as u32);
        let (agents, _) = uniform_points(rows, 1);
        let (goals, _) = uniform_points(cols, 2);
        let euclidean = distances(&agents, &goals, 2).unwrap();
        let product = (0..rows * cols).map(|k| ((k / cols + 1) * (k % cols + 1)) as f64).collect();
        let mut draw = |values: u32| (0..rows * cols).map(|_| f64::from(stream.below(values))).collect::<Vec<f64>>();
        for (kind, cost) in [euclidean, product, draw(2), draw(40), draw(4000), draw(u32::MAX)].iter().enumerate() {
            let expected = without.solve(cost, rows, cols).unwrap();
            assert_eq!(with.solve(cost, rows, cols).unwrap(), expected, "{rows} x {cols}, kind {kind}");
        }
        let mut forbidden = draw(4000);
        forbidden.iter_mut().step_by(3).for_each(|cost| *cost = f64::INFINITY);
        let answers =
            [&mut with, &mut without].map(|solver| solver.solve_allowed(&forbidden, rows, cols, &|| true).unwrap());
        assert_eq!(answers[0], answers[1]);
    }
}

#[test]
fn equal_costs_are_solved_at_once_whatever_their_size() {
    for value in [0.0, -0.0, 0.1, -7.25, 1e300, -1e300, 1e-300] {
        for (rows, cols) in [(300, 300), (200, 300), (300, 200)] {
            let answer = exact(&vec![value; rows * cols], rows, cols).unwrap();
            check_matching(&(rows, cols, vec![value; rows * cols]), &answer);
        }
    }
}

#[test]
fn structured_costs_that_make_augmenting_paths_long() {
    for n in [40usize, 200] {
        let product: Vec<f64> = (0..n * n).map(|k| ((k / n + 1) * (k % n + 1)) as f64).collect();
        let opposite: f64 = (1..=n).map(|i| (i * (n + 1 - i)) as f64).sum();
        assert_eq!(exact(&product, n, n).unwrap().cost, opposite);
        let distance: Vec<f64> = (0..n * n).map(|k| (k / n).abs_diff(k % n) as f64).collect();
        assert_eq!(exact(&distance, n, n).unwrap().col_of_row, (0..n as u32).collect::<Vec<_>>());
    }
}

#[test]
fn bad_problems_are_refused_and_named() {
    let message = |cost: &[f64], rows, cols| exact(cost, rows, cols).unwrap_err().to_string();
    assert_eq!(message(&[1.0, f64::NAN], 1, 2), "cost[0][1]: NaN is not a finite number up to 1e300");
    assert!(message(&[1.0, 2.0, f64::NEG_INFINITY, 0.0], 2, 2).starts_with("cost[1][0]: -inf"));
    assert!(message(&[1e301], 1, 1).contains("cost[0][0]"));
    assert!(message(&[], 0, 3).contains("empty"));
    assert!(message(&[1.0; 5], 2, 3).contains("5 numbers, the shape asks for 6"));
    assert!(message(&[1.0; 5], usize::MAX, 3).contains("too large"));
    let points = |a: &[f32], g: &[f32], dims| exact_points(a, g, dims).unwrap_err().to_string();
    assert_eq!(points(&[0.0, 1.0], &[0.0, f32::INFINITY], 2), "goals[0][1]: inf is not finite");
    assert!(points(&[0.0; 3], &[0.0; 2], 2).contains("agents: 3 numbers"));
    assert!(points(&[0.0; 2], &[], 2).contains("empty"));
    assert!(points(&[0.0; 2], &[0.0; 2], 0).contains("dims"));
}

#[test]
fn points_in_one_two_and_three_dimensions() {
    let (goals, cost) = exact_points(&[0.0, 10.0], &[9.0, 1.0], 1).unwrap();
    assert_eq!((goals, cost), (vec![1, 0], 2.0));
    let (goals, cost) = exact_points(&[0.0, 0.0, 0.0, 3.0], &[3.0, 4.0], 2).unwrap();
    assert_eq!((goals, cost), (vec![UNASSIGNED, 0], 10f64.sqrt()));
    let (goals, cost) = exact_points(&[1.0, 2.0, 2.0], &[9.0, 9.0, 9.0, 0.0, 0.0, 0.0], 3).unwrap();
    assert_eq!((goals, cost), (vec![1], 3.0));
}

#[test]
fn random_matchings_are_uniform() {
    let mut counts = [0u32; 12];
    let mut stream = stream(1);
    for _ in 0..12_000 {
        let cols = random::random(2, 4, &mut stream).unwrap();
        let second = if cols[1] > cols[0] { cols[1] - 1 } else { cols[1] };
        counts[(cols[0] * 3 + second) as usize] += 1;
    }
    assert!(counts.iter().all(|count| (850..1150).contains(count)), "{counts:?}");
    let tall = random::random(5, 2, &mut stream).unwrap();
    assert_eq!(tall.iter().filter(|&&col| col == UNASSIGNED).count(), 3);
}

/// The cost of "most regret first, cheapest remaining goal", both by reduced cost.
fn by_regret(cost: &[f32], n: usize, duals: &duals::Duals) -> Vec<u32> {
    let reduced = |row: usize, col: usize| duals.reduced(cost[row * n + col], row, col);
    let regret = |row: usize| {
        let mut of_row: Vec<f32> = (0..n).map(|col| reduced(row, col)).collect();
        of_row.sort_by(f32::total_cmp);
        of_row[1] - of_row[0]
    };
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| regret(b).total_cmp(&regret(a)).then(a.cmp(&b)));
    let mut left: Vec<usize> = (0..n).collect();
    let mut col_of_row = vec![UNASSIGNED; n];
    for row in order {
        let best = (0..left.len()).min_by(|&a, &b| reduced(row, left[a]).total_cmp(&reduced(row, left[b]))).unwrap();
        col_of_row[row] = left.remove(best) as u32;
    }
    col_of_row
}

#[test]
fn duals_lead_close_to_the_optimum() {
    for (n, instances, limit) in [(5, 100, 1.001), (20, 50, 1.003), (50, 40, 1.003), (150, 4, 1.01)] {
        let mut total = 0.0;
        for index in 0..instances {
            let (agents, goals) = uniform_points(n, index);
            let cost = distances(&agents, &goals, 2).unwrap();
            let narrow: Vec<f32> = cost.iter().map(|&c| c as f32).collect();
            let duals = sinkhorn_duals(&narrow, n, n).unwrap();
            total += cost_of(&cost, n, &by_regret(&narrow, n, &duals)) / exact(&cost, n, n).unwrap().cost;
        }
        let ratio = total / f64::from(instances);
        assert!((1.0 - 1e-9..limit).contains(&ratio), "n = {n}: {ratio}");
    }
}

#[test]
fn duals_of_awkward_costs_are_finite_and_follow_the_unit() {
    let mut stream = stream(9);
    let wild: Vec<f32> = (0..20 * 30).map(|_| 10f32.powi(stream.below(24) as i32 - 12)).collect();
    let two_levels: Vec<f32> = (0..20 * 30).map(|k| if k % 7 == 0 { 0.0 } else { 1e9 }).collect();
    let flat = vec![3.0; 600];
    for (name, cost) in [("wild", &wild), ("levels", &two_levels), ("flat", &flat), ("zero", &vec![0.0; 600])] {
        for (rows, cols) in [(20, 30), (30, 20), (1, 600), (600, 1)] {
            let duals = sinkhorn_duals(cost, rows, cols).unwrap();
            assert_eq!((duals.rows.len(), duals.cols.len()), (rows, cols));
            let finite = duals.rows.iter().chain(&duals.cols).all(|x| x.is_finite());
            assert!(finite, "{name} {rows} x {cols}: {duals:?}");
        }
    }
    let uniform: Vec<f32> = (0..400).map(|_| stream.uniform32()).collect();
    let doubled: Vec<f32> = uniform.iter().map(|c| c * 1024.0).collect();
    let (one, other) = (sinkhorn_duals(&uniform, 20, 20).unwrap(), sinkhorn_duals(&doubled, 20, 20).unwrap());
    assert!(one.cols.iter().zip(&other.cols).all(|(a, b)| a * 1024.0 == *b));
}

#[test]
fn the_bits_of_the_duals_are_pinned() {
    let (agents, goals) = uniform_points(37, 0);
    let cost: Vec<f32> = distances(&agents, &goals, 2).unwrap().iter().map(|&c| c as f32).collect();
    let duals = sinkhorn_duals(&cost, 37, 37).unwrap();
    let mix = |hash: u32, value: &f32| hash.rotate_left(5).wrapping_mul(0x9e37_79b9) ^ value.to_bits();
    assert_eq!(duals.rows.iter().chain(&duals.cols).fold(0, mix), 197_731_012);
}

#[test]
fn duals_refuse_bad_input_by_name() {
    let refuse = |cost: &[f32]| sinkhorn_duals(cost, 1, 2).unwrap_err().to_string();
    assert!(refuse(&[1.0, f32::NAN]).starts_with("cost[0][1]: NaN"));
    assert!(refuse(&[1.0]).contains("1 numbers"));
}
