//! The learning curve of a run as a picture: the episode metrics that have a plot, over joint steps.

use magex_core::metrics_table::{METRICS, Metric, Scale, Scope};
use plotters::coord::Shift;
use plotters::prelude::*;
use serde::Deserialize;
use serde_json::{Map, Value};
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
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct MetricsPoint {
    /// Number of the iteration.
    pub iteration: u64,
    /// Steps of whole teams since the start of the run.
    pub joint_env_steps: u64,
    /// The columns of the episodes' metrics, among others.
    #[serde(flatten)]
    pub columns: Map<String, Value>,
}

impl MetricsPoint {
    fn get(&self, column: &str) -> Option<f64> {
        self.columns.get(column)?.as_f64()
    }
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
            for column in METRICS.iter().filter_map(|metric| metric.sampled) {
                if point.get(column).is_none()
                    && let Some(value) = last.columns.get(column)
                {
                    point.columns.insert(column.to_owned(), value.clone());
                }
            }
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
/// Heights of a panel, of a panel of shares, and of the labels of the shared axis below the last one.
const HEIGHT: u32 = 170;
const SHARES: u32 = 260;
const AXIS: u32 = 44;
const FONT: &str = "Inter, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif";
const INK: RGBColor = RGBColor(27, 31, 39);
const SOFT: RGBColor = RGBColor(102, 112, 133);
const GRID: RGBColor = RGBColor(228, 231, 236);
const BLUE: RGBColor = RGBColor(47, 111, 222);
const GREEN: RGBColor = RGBColor(29, 154, 98);

/// One line of a panel.
struct Series {
    label: &'static str,
    color: RGBColor,
    /// With a dot at every point: for series with few points.
    dots: bool,
    points: Vec<(f64, f64)>,
}

/// The picture as SVG text. `title` is the run's name, `subtitle` its configuration in one line.
///
/// # Errors
/// No points, or a failure of the drawing library.
pub fn curve_svg(title: &str, subtitle: &str, points: &[MetricsPoint]) -> Result<String, CurveError> {
    let last = points.last().ok_or(CurveError::Empty)?.joint_env_steps as f64;
    let mut svg = String::new();
    {
        let panels: Vec<(&Metric, Scale, Vec<Series>)> = METRICS.iter().filter_map(|m| panel_of(m, points)).collect();
        let heights = panels.iter().enumerate().map(|(index, (_, scale, _))| {
            let axis = if index + 1 == panels.len() { AXIS } else { 0 };
            axis + if *scale == Scale::Share { SHARES } else { HEIGHT }
        });
        let heights: Vec<u32> = heights.collect();
        let root = SVGBackend::with_string(&mut svg, (WIDTH, HEADER + heights.iter().sum::<u32>())).into_drawing_area();
        root.fill(&WHITE).map_err(drawing)?;
        let (header, mut rest) = root.split_vertically(HEADER);
        header.draw_text(title, &text(26).color(&INK), (24, 14)).map_err(drawing)?;
        header.draw_text(subtitle, &text(15).color(&SOFT), (24, 42)).map_err(drawing)?;
        for (index, (metric, scale, series)) in panels.iter().enumerate() {
            let (area, below) = rest.split_vertically(heights[index]);
            let name = format!("{}, {}", metric.label, metric.unit);
            panel(&area, &name, *scale, series, last, index + 1 == panels.len())?;
            rest = below;
        }
        root.present().map_err(drawing)?;
    }
    Ok(svg)
}

/// The plot of a metric, if it has one and the run has the metric.
fn panel_of<'a>(metric: &'a Metric, points: &[MetricsPoint]) -> Option<(&'a Metric, Scale, Vec<Series>)> {
    let scale = metric.plot?;
    let sampled = metric.sampled.map(|column| line("sampled, training episodes", BLUE, points, column));
    let greedy = metric.greedy().then(|| line("greedy evaluation", GREEN, points, metric.name));
    let mut series: Vec<Series> = sampled.into_iter().chain(greedy).collect();
    if let [_, greedy] = &mut series[..] {
        greedy.dots = true;
    }
    let measured = series.iter().flat_map(|one| &one.points).any(|&(_, value)| value != 0.0);
    (measured || metric.scope == Scope::EveryTask).then_some((metric, scale, series))
}

fn line(label: &'static str, color: RGBColor, points: &[MetricsPoint], column: &str) -> Series {
    let place = |p: &MetricsPoint| p.get(column).filter(|y| y.is_finite()).map(|y| (p.joint_env_steps as f64, y));
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
        Scale::Free => smallest,
    };
    let high = match scale {
        Scale::Share => largest.max(1.0),
        Scale::FromZero | Scale::Free => low + (largest - low) * 1.08,
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
    use serde_json::json;

    const LINE: &str = r#"{"iteration":0,"joint_env_steps":1000,"success_rate":null,"reward":-1.5,"loss":3}"#;

    #[test]
    fn a_metrics_file_is_read_as_it_is_written() {
        let again = LINE.replace("null", "0.25");
        let next = LINE.replace("\"iteration\":0", "\"iteration\":1");
        let points = parse_metrics(&format!("{LINE}\n{next}\n{again}\n\n{next}\n{{\"iter")).unwrap();
        assert_eq!(points.len(), 2, "the resumed iterations replace the old ones");
        assert_eq!(["success_rate", "cost_ratio", "reward"].map(|c| points[0].get(c)), [Some(0.25), None, Some(-1.5)]);
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
        assert_eq!(["success_rate", "sampled_success_rate"].map(|c| points[0].get(c)), [Some(0.75), Some(0.25)]);
    }

    #[test]
    fn every_curve_can_be_drawn_and_text_is_escaped() {
        let mut points = parse_metrics(&format!("{LINE}\n")).unwrap();
        let svg = curve_svg("a <run> & more", "N = 5", &points).unwrap();
        assert!(svg.contains("a &lt;run&gt; &amp; more") && svg.contains("no data yet") && svg.ends_with("</svg>\n"));
        let more = |k: u64| {
            let line = json!({
                "iteration": k, "joint_env_steps": 1000 + 10_000 * k, "sampled_success_rate": k as f64 / 300.0,
                "success_rate": k.is_multiple_of(10).then_some(0.5), "collisions_per_agent_step": 0.0, "cost_ratio": 1.0,
                "arrival_step": 120.0, "second_cost_ratio": null,
            });
            format!("{line}\n")
        };
        points.extend(parse_metrics(&(1..300).map(more).collect::<String>()).unwrap());
        let svg = curve_svg("run", "", &points).unwrap();
        assert!(!svg.contains("NaN") && svg.contains("joint environment steps"));
        assert!(svg.contains("arrival, steps") && !svg.contains("second cost"), "no panel without the metric");
        assert!(matches!(curve_svg("run", "", &[]), Err(CurveError::Empty)));
    }

    #[test]
    fn step_counts_are_short() {
        for (value, text) in [(0.0, "0"), (500.0, "500"), (250_000.0, "250k"), (1_500_000.0, "1.5M"), (2e9, "2G")] {
            assert_eq!(steps(value), text);
        }
    }
}
