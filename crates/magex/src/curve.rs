//! The learning curve of a run as a picture: success, arrival, collisions and assignment cost over joint steps.

use plotters::coord::Shift;
use plotters::prelude::*;
use serde::Deserialize;
use thiserror::Error;

/// Why a picture could not be drawn.
#[derive(Debug, Error)]
pub enum CurveError {
    /// A line of the metrics file is not what it should be.
    #[error("metrics.jsonl line {line}: {reason}")]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// The file has no lines yet.
    #[error("metrics.jsonl: no iterations yet; wait for the first one to finish")]
    Empty,
    /// The drawing library gave up.
    #[error("learning curve: {0}")]
    Drawing(String),
}

/// One iteration, as far as the picture needs it. What a line does not have, or has as null, is not drawn.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct MetricsPoint {
    /// Number of the iteration.
    pub iteration: u64,
    /// Steps of whole teams since the start of the run.
    pub joint_env_steps: u64,
    /// Share of landmarks covered at the end, greedy evaluation.
    #[serde(default)]
    pub success_rate: Option<f64>,
    /// The same in the sampled training episodes.
    #[serde(default)]
    pub sampled_success_rate: Option<f64>,
    /// Other agents in contact, per agent and step.
    #[serde(default)]
    pub collisions_per_agent_step: Option<f64>,
    /// Cost of the commander's assignment / cost of the exact one.
    #[serde(default)]
    pub cost_ratio: Option<f64>,
    /// First step with at least 99 % of the landmarks covered.
    #[serde(default)]
    pub arrival_step: Option<f64>,
    /// Mean reward per agent and step.
    #[serde(default)]
    pub reward: Option<f64>,
}

/// Reads a metrics file. A last line without its end is left out (the run may be writing it), and an iteration that
/// occurs twice counts as it was written last (the run was resumed before it).
///
/// # Errors
/// A line that is not a JSON object with `iteration` and `joint_env_steps`; a file without lines.
pub fn parse_metrics(text: &str) -> Result<Vec<MetricsPoint>, CurveError> {
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let mut points: Vec<MetricsPoint> = Vec::new();
    for (index, line) in whole.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let mut point: MetricsPoint = serde_json::from_str(line)
            .map_err(|error| CurveError::Line { line: index + 1, reason: error.to_string() })?;
        // The last line of a run only evaluates, under the number of the iteration before it.
        if let Some(last) = points.last().filter(|last| last.iteration == point.iteration) {
            point.sampled_success_rate = point.sampled_success_rate.or(last.sampled_success_rate);
            point.reward = point.reward.or(last.reward);
        }
        while points.last().is_some_and(|last| last.iteration >= point.iteration) {
            points.pop();
        }
        points.push(point);
    }
    if points.is_empty() { Err(CurveError::Empty) } else { Ok(points) }
}

const WIDTH: u32 = 960;
const HEADER: u32 = 64;
/// Heights of the panels; the last one also carries the labels of the shared axis.
const PANELS: [u32; 4] = [260, 170, 170, 214];
const FONT: &str = "Inter, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";
const INK: RGBColor = RGBColor(27, 31, 39);
const SOFT: RGBColor = RGBColor(102, 112, 133);
const GRID: RGBColor = RGBColor(228, 231, 236);
const BLUE: RGBColor = RGBColor(47, 111, 222);
const GREEN: RGBColor = RGBColor(29, 154, 98);
const AMBER: RGBColor = RGBColor(201, 138, 11);
const RED: RGBColor = RGBColor(214, 64, 52);
const VIOLET: RGBColor = RGBColor(124, 77, 190);

/// One line of a panel.
struct Series {
    label: &'static str,
    color: RGBColor,
    /// With a dot at every point: for series with few points.
    dots: bool,
    points: Vec<(f64, f64)>,
}

/// How the vertical axis of a panel is chosen.
#[derive(Clone, Copy)]
enum Scale {
    /// 0 to 1.
    Share,
    /// 0 to a little above the largest value.
    FromZero,
    /// 1 (or the smallest value, if that is less) to a little above the largest value.
    FromOne,
}

/// The picture as SVG text. `title` is the run's name, `subtitle` its configuration in one line.
///
/// # Errors
/// No points, or a failure of the drawing library.
pub fn curve_svg(title: &str, subtitle: &str, points: &[MetricsPoint]) -> Result<String, CurveError> {
    let last = points.last().ok_or(CurveError::Empty)?.joint_env_steps as f64;
    let mut svg = String::new();
    {
        let height = HEADER + PANELS.iter().sum::<u32>();
        let root = SVGBackend::with_string(&mut svg, (WIDTH, height)).into_drawing_area();
        root.fill(&WHITE).map_err(drawing)?;
        let (header, mut rest) = root.split_vertically(HEADER);
        header.draw_text(title, &text(26).color(&INK), (24, 14)).map_err(drawing)?;
        header.draw_text(subtitle, &text(15).color(&SOFT), (24, 42)).map_err(drawing)?;
        let panels = [
            ("success rate", Scale::Share, success(points)),
            (
                "arrival step (99 % covered)",
                Scale::FromZero,
                vec![line("arrival step", VIOLET, points, |p| p.arrival_step)],
            ),
            (
                "contacts / agent · step",
                Scale::FromZero,
                vec![line("contacts", RED, points, |p| p.collisions_per_agent_step)],
            ),
            ("assignment cost / exact", Scale::FromOne, vec![line("cost ratio", AMBER, points, |p| p.cost_ratio)]),
        ];
        for (index, (name, scale, series)) in panels.iter().enumerate() {
            let (area, below) = rest.split_vertically(PANELS[index]);
            panel(&area, name, *scale, series, last, index + 1 == PANELS.len())?;
            rest = below;
        }
        root.present().map_err(drawing)?;
    }
    Ok(svg)
}

fn success(points: &[MetricsPoint]) -> Vec<Series> {
    let mut greedy = line("greedy evaluation", GREEN, points, |p| p.success_rate);
    greedy.dots = true;
    vec![line("sampled, training episodes", BLUE, points, |p| p.sampled_success_rate), greedy]
}

fn line(
    label: &'static str,
    color: RGBColor,
    points: &[MetricsPoint],
    value: impl Fn(&MetricsPoint) -> Option<f64>,
) -> Series {
    let place = |p: &MetricsPoint| value(p).filter(|y| y.is_finite()).map(|y| (p.joint_env_steps as f64, y));
    let points: Vec<_> = points.iter().filter_map(place).collect();
    Series { label, color, dots: points.len() <= 60, points }
}

fn panel(
    area: &DrawingArea<SVGBackend<'_>, Shift>,
    name: &str,
    scale: Scale,
    series: &[Series],
    last: f64,
    bottom: bool,
) -> Result<(), CurveError> {
    let (low, high) = limits(scale, series);
    let mut chart = ChartBuilder::on(area)
        .margin_left(18)
        .margin_right(28)
        .margin_top(26)
        .margin_bottom(if bottom { 8 } else { 4 })
        .y_label_area_size(58)
        .x_label_area_size(if bottom { 44 } else { 0 })
        .build_cartesian_2d(0.0..last.max(1.0), low..high)
        .map_err(drawing)?;
    let (decimals, rows) = (decimals(high - low), if matches!(scale, Scale::Share) { 6 } else { 4 });
    chart
        .configure_mesh()
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .axis_style(GRID.stroke_width(1))
        .x_labels(9)
        .y_labels(rows)
        .x_desc(if bottom { "joint environment steps" } else { "" })
        .x_label_formatter(&|x| steps(*x))
        .y_label_formatter(&|y| format!("{y:.decimals$}"))
        .label_style(text(14).color(&SOFT))
        .axis_desc_style(text(15).color(&INK))
        .draw()
        .map_err(drawing)?;
    for one in series {
        let faint = series.len() > 1 && !one.dots;
        let style = if faint { one.color.mix(0.75).stroke_width(1) } else { one.color.stroke_width(2) };
        chart.draw_series(LineSeries::new(one.points.iter().copied(), style)).map_err(drawing)?;
        if one.dots {
            let dots = one.points.iter().map(|&place| Circle::new(place, 3, one.color.filled()));
            chart.draw_series(dots).map_err(drawing)?;
        }
    }
    area.draw_text(name, &text(16).color(&INK), (24, 6)).map_err(drawing)?;
    legend(area, series)
}

/// "— name: last value" for every line, right-aligned in the panel's head.
fn legend(area: &DrawingArea<SVGBackend<'_>, Shift>, series: &[Series]) -> Result<(), CurveError> {
    let mut right = WIDTH as i32 - 28;
    for one in series.iter().rev() {
        let value = one.points.last().map_or("no data yet".to_owned(), |&(_, y)| short(y));
        let label = if series.len() > 1 { format!("{}  {value}", one.label) } else { format!("last  {value}") };
        // Without font files the width of a text is an estimate.
        let width = (label.chars().count() as f64 * 6.0) as i32;
        right -= width;
        area.draw_text(&label, &text(14).color(&one.color), (right, 7)).map_err(drawing)?;
        let bar = [(right - 24, 13), (right - 6, 13)];
        area.draw(&PathElement::new(bar, one.color.stroke_width(3))).map_err(drawing)?;
        right -= 44;
    }
    Ok(())
}

fn limits(scale: Scale, series: &[Series]) -> (f64, f64) {
    let values = || series.iter().flat_map(|one| &one.points).map(|&(_, y)| y);
    let largest = values().fold(f64::NEG_INFINITY, f64::max);
    let smallest = values().fold(f64::INFINITY, f64::min);
    if !largest.is_finite() {
        return if matches!(scale, Scale::FromOne) { (1.0, 2.0) } else { (0.0, 1.0) };
    }
    let low = match scale {
        Scale::Share | Scale::FromZero => smallest.min(0.0),
        Scale::FromOne => smallest.min(1.0),
    };
    let high = match scale {
        Scale::Share => largest.max(1.0),
        Scale::FromZero => low + (largest - low) * 1.08,
        // Differences below a percent are noise to look at, and their labels would all read the same.
        Scale::FromOne => low + ((largest - low) * 1.08).max(0.05),
    };
    // A flat line still needs an axis.
    (low, if high - low > 1e-9 { high } else { low + 0.1 })
}

/// Digits after the point that tell the labels of an axis of this length apart.
fn decimals(span: f64) -> usize {
    if span >= 8.0 {
        0
    } else if span >= 0.5 {
        1
    } else if span >= 0.05 {
        2
    } else {
        3
    }
}

/// The digits worth reading of a last value.
fn short(value: f64) -> String {
    let decimals = match value.abs() {
        v if v >= 10.0 => 1,
        v if v >= 0.1 => 3,
        _ => 4,
    };
    format!("{value:.decimals$}")
}

/// 0, 500k, 1.5M.
fn steps(value: f64) -> String {
    let with = |value: f64, suffix: &str| {
        let text = format!("{value:.2}");
        format!("{}{suffix}", text.trim_end_matches('0').trim_end_matches('.'))
    };
    match value {
        v if v >= 1e9 => with(v / 1e9, "G"),
        v if v >= 1e6 => with(v / 1e6, "M"),
        v if v >= 1e3 => with(v / 1e3, "k"),
        v => format!("{v:.0}"),
    }
}

fn text(size: u32) -> TextStyle<'static> {
    TextStyle::from((FONT, size))
}

fn drawing(error: impl std::fmt::Display) -> CurveError {
    CurveError::Drawing(error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = r#"{"iteration":0,"joint_env_steps":1000,"success_rate":null,"reward":-1.5,"loss":3}"#;

    #[test]
    fn a_metrics_file_is_read_as_it_is_written() {
        let again = LINE.replace("null", "0.25");
        let next = LINE.replace("\"iteration\":0", "\"iteration\":1");
        let points = parse_metrics(&format!("{LINE}\n{next}\n{again}\n\n{next}\n{{\"iter")).unwrap();
        assert_eq!(points.len(), 2, "the resumed iterations replace the old ones");
        assert_eq!((points[0].success_rate, points[0].cost_ratio, points[0].reward), (Some(0.25), None, Some(-1.5)));
        assert!(matches!(parse_metrics(""), Err(CurveError::Empty)));
        let error = parse_metrics(&format!("{LINE}\nnonsense\n")).unwrap_err().to_string();
        assert!(error.starts_with("metrics.jsonl line 2"), "{error}");
        let error = parse_metrics("{\"iteration\":3}\n").unwrap_err().to_string();
        assert!(error.contains("joint_env_steps"), "{error}");
    }

    #[test]
    fn the_closing_evaluation_keeps_what_its_iteration_trained() {
        let line = |success: &str, sampled: &str| {
            format!(
                "{{\"iteration\":4,\"joint_env_steps\":9,\"success_rate\":{success},\"sampled_success_rate\":{sampled}}}\n"
            )
        };
        let points = parse_metrics(&(line("0.5", "0.25") + &line("0.75", "null"))).unwrap();
        assert_eq!(points.len(), 1);
        assert_eq!((points[0].success_rate, points[0].sampled_success_rate), (Some(0.75), Some(0.25)));
    }

    #[test]
    fn every_curve_can_be_drawn_and_text_is_escaped() {
        let mut points = parse_metrics(&format!("{LINE}\n")).unwrap();
        let svg = curve_svg("a <run> & more", "N = 5", &points).unwrap();
        assert!(svg.contains("a &lt;run&gt; &amp; more") && svg.contains("no data yet") && svg.ends_with("</svg>\n"));
        let base = points[0];
        points.extend((1..300u64).map(|k| MetricsPoint {
            iteration: k,
            joint_env_steps: 1000 + 10_000 * k,
            success_rate: (k % 10 == 0).then_some(f64::NAN),
            sampled_success_rate: Some(k as f64 / 300.0),
            collisions_per_agent_step: Some(0.0),
            cost_ratio: Some(1.0),
            arrival_step: Some(120.0),
            ..base
        }));
        let svg = curve_svg("run", "", &points).unwrap();
        assert!(!svg.contains("NaN") && svg.contains("joint environment steps"));
        assert!(matches!(curve_svg("run", "", &[]), Err(CurveError::Empty)));
    }

    #[test]
    fn step_counts_are_short() {
        for (value, text) in [(0.0, "0"), (500.0, "500"), (250_000.0, "250k"), (1_500_000.0, "1.5M"), (2e9, "2G")] {
            assert_eq!(steps(value), text);
        }
    }
}
