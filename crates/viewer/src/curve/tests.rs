use super::*;

const LINE: &str =
    r#"{"iteration":0,"joint_env_steps":0,"success_rate":null,"reward":-1.5,"executor":{"value_loss":3}}"#;

/// A run of `count` lines with an evaluation in every tenth.
fn run(count: u64, more: impl Fn(u64) -> String) -> String {
    let line = |k: u64| {
        let success = if k.is_multiple_of(10) { "0.5" } else { "null" };
        format!(
            "{{\"iteration\":{k},\"joint_env_steps\":{},\"success_rate\":{success},\"sampled_success_rate\":{},\
             \"collisions_per_agent_step\":0.0,\"cost_ratio\":1.0,\"arrival_step\":120{}}}\n",
            10_000 * k,
            k as f64 / count as f64,
            more(k)
        )
    };
    (0..count).map(line).collect()
}

fn draw(text: &str) -> String {
    curve_svg("run", "", &parse_metrics(text).unwrap()).unwrap()
}

#[test]
fn a_metrics_file_is_read_as_it_is_written() {
    let again = LINE.replace("null", "0.25");
    let next = LINE.replace("\"iteration\":0", "\"iteration\":1");
    let lines = parse_metrics(&format!("{LINE}\n{next}\n{again}\n\n{next}\n{{\"iter")).unwrap();
    assert_eq!(lines.len(), 2, "the resumed iterations replace the old ones");
    let values =
        ["success_rate", "cost_ratio", "reward", "executor/value_loss", "reward/x"].map(|key| lines[0].get(key));
    assert_eq!(values, [Some(0.25), None, Some(-1.5), Some(3.0), None]);
    assert_eq!(parse_metrics(""), Err(empty()));
    let error = parse_metrics(&format!("{LINE}\nnonsense\n")).unwrap_err().to_string();
    assert!(error.starts_with("metrics.jsonl line 2"), "{error}");
    let error = parse_metrics("{\"iteration\":3}\n").unwrap_err().to_string();
    assert!(error.contains("joint_env_steps"), "{error}");
}

#[test]
fn every_curve_can_be_drawn_and_text_is_escaped() {
    let svg = curve_svg("a <run> & more", "N = 5", &parse_metrics(&format!("{LINE}\n")).unwrap()).unwrap();
    assert!(svg.contains("a &lt;run&gt; &amp; more") && svg.contains("no data yet") && svg.ends_with("</svg>\n"));
    assert!(svg.contains(">Value loss<") && !svg.contains(">Policy loss"), "what the run has");
    let svg = draw(&run(300, |_| String::new()));
    assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.contains("joint environment steps"));
    // Success greedy (30 points, with dots) and sampled, arrival, reward (no points); the rest is constant or not there.
    assert_eq!((svg.matches("<polyline").count(), svg.matches("<circle").count()), (4, 30));
    assert!(svg.contains("Arrival, steps; never counts as horizon + 1") && !svg.contains("Second cost"));
    assert_eq!(curve_svg("run", "", &[]), Err(empty()));
}

#[test]
fn what_is_as_good_as_it_can_be_throughout_is_one_line() {
    let svg = draw(&run(20, |_| String::new()));
    assert!(svg.contains(">Cost, ratio: 1.0000 throughout, which is the best there is<"), "{svg}");
    assert!(svg.contains(">Collisions, per agent and step: 0.0000 throughout"));
    let worse = draw(&run(20, |k| format!(",\"sampled_cost_ratio\":{}", if k == 3 { 1.01 } else { 1.0 })));
    assert!(!worse.contains("Cost, ratio: ") && worse.contains(">Cost, ratio<"));
}

#[test]
fn the_value_loss_is_logarithmic_where_its_range_is_wide() {
    let loss = |k: u64, low: f64| format!(",\"executor\":{{\"value_loss\":{}}}", if k == 0 { 3.0 } else { low });
    assert!(draw(&run(20, |k| loss(k, 0.01))).contains(">Value loss, log scale<"));
    assert!(draw(&run(20, |k| loss(k, 1.0))).contains(">Value loss<"));
    assert!(draw(&run(20, |k| loss(k, -1.0))).contains(">Value loss<"), "a negative number has no logarithm");
}

#[test]
fn an_evaluation_before_the_first_update_is_drawn_at_step_0() {
    let svg = draw(&run(20, |_| String::new()));
    let attribute = |element: &str, name: &str| {
        let value = element.split_once(&format!(" {name}=\"")).unwrap().1;
        value.split('"').next().unwrap().to_owned()
    };
    let greedy = svg.lines().find(|line| line.starts_with("<circle class=\"greedy\"")).unwrap();
    let zero =
        svg.lines().find(|line| line.ends_with(">0<") || line.contains("text-anchor=\"middle\">0</text>")).unwrap();
    assert_eq!(attribute(greedy, "cx"), attribute(zero, "x"));
}

#[test]
fn names_and_colours_are_those_of_the_table_and_nothing_else_has_a_colour() {
    let losses =
        |k: u64| format!(",\"reward\":-1,\"executor\":{{\"entropy\":1,\"policy_loss\":-0.1,\"value_loss\":{}}}", k + 1);
    let svg = draw(&run(20, losses));
    let (before, rest) = svg.split_once("<style>").unwrap();
    let (style, after) = rest.split_once("</style>").unwrap();
    assert_eq!(style.matches("@media (prefers-color-scheme: dark)").count(), 1);
    let (light, dark) = style.split_once("@media").unwrap();
    for kind in Kind::ALL {
        let look = kind.look();
        assert!(light.contains(&format!(".{}{{color:{}}}", look.class, look.light)), "{light}");
        assert!(dark.contains(&format!(".{}{{color:{}}}", look.class, look.dark)), "{dark}");
    }
    for kind in [Kind::Greedy, Kind::Sampled, Kind::Actor, Kind::Critic] {
        let look = kind.look();
        assert!(after.contains(&format!("<tspan class=\"{}\">━ {} ", look.class, look.label)) || kind == Kind::Sampled);
        assert!(
            after.contains(&format!("━ {} ", look.label))
                && after.contains(&format!("<polyline class=\"{}\"", look.class))
        );
    }
    for other in ["#", "fill=", "stroke=\"", "style="] {
        assert!(!before.contains(other) && !after.contains(other), "{other} outside the style block");
    }
    for plot in plots::all().iter().filter(|plot| plot.picture && (plot.always || plot.id == "entropy")) {
        assert!(after.contains(&format!(">{}, {}", plot.title, plot.unit)), "{}", plot.title);
    }
}

#[test]
fn labels_do_not_overlap_and_stay_inside_the_picture() {
    let svg = draw(&run(47, |k| format!(",\"executor\":{{\"policy_loss\":{}}}", -0.0123 + 1e-4 * k as f64)));
    let mut rows: std::collections::BTreeMap<String, Vec<[f64; 2]>> = std::collections::BTreeMap::new();
    for line in svg.lines().filter(|line| line.starts_with("<text class=\"soft label\"")) {
        let part = |start: &str| line.split_once(start).unwrap().1.split(['"', '<']).next().unwrap().to_owned();
        let (x, words) = (part(" x=\"").parse::<f64>().unwrap(), line.split_once('>').unwrap().1);
        let width = DIGIT * words.trim_end_matches("</text>").chars().count() as f64;
        let left = if line.contains("\"end\"") { x - width } else { x - width / 2.0 };
        rows.entry(part(" y=\"")).or_default().push([left, left + width]);
    }
    assert!(rows.len() > 8 && svg.contains(">-0.012<"), "{svg}");
    for row in rows.values_mut() {
        row.sort_by(|a, b| a[0].total_cmp(&b[0]));
        assert!(row[0][0] >= MARGIN - DIGIT && row[row.len() - 1][1] <= WIDTH, "{row:?}");
        assert!(row.windows(2).all(|pair| pair[0][1] < pair[1][0]), "{row:?}");
    }
}

#[test]
fn an_environment_of_the_users_own_has_its_return_in_the_large_plot_and_no_empty_ones() {
    let line = |k: u64| {
        format!(
            "{{\"iteration\":{k},\"joint_env_steps\":{},\"success_rate\":null,\"collisions_per_agent_step\":null,\
             \"arrival_step\":null,\"cost_ratio\":null,\"episode_return\":{},\"sampled_episode_return\":-30,\"reward\":-1}}\n",
            1000 * k,
            -20.0 + k as f64
        )
    };
    let svg = draw(&(0..5).map(line).collect::<String>());
    assert!(svg.contains(">Return, per agent<") && svg.contains(">Reward, "), "{svg}");
    for absent in ["no data yet", "Success", "Arrival", "Collisions", "Cost"] {
        assert!(!svg.contains(absent), "{absent} in {svg}");
    }
    // The first panel, and as wide as the picture.
    let (first, second) = (svg.find("Return, ").unwrap(), svg.find("Reward, ").unwrap());
    assert!(first < second);
}
