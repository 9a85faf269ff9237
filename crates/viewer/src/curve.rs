//! The learning curve of a run as an SVG picture: the episode metrics that have a plot, over joint steps.

use magex_core::error::FieldError;
use magex_core::metrics_table::{METRICS, Metric, Scale, Scope};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::fmt::Write as _;

/// One iteration of `metrics.jsonl`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct MetricsLine {
    /// Number of the iteration.
    pub iteration: u64,
    /// Steps of whole teams since the start of the run.
    pub joint_env_steps: u64,
    /// Everything else on the line.
    #[serde(flatten)]
    values: Map<String, Value>,
}

impl MetricsLine {
    /// A metric by its key; `None` if the line does not have it, or has it as null.
    pub fn get(&self, key: &str) -> Option<f64> {
        self.values.get(key).and_then(Value::as_f64)
    }
}

/// Reads a metrics file. An unterminated last line is ignored (the run may be writing it). If an iteration occurs twice
/// because the run was resumed before it, the later line counts. A file without lines is refused.
pub fn parse_metrics(text: &str) -> Result<Vec<MetricsLine>, FieldError> {
    let whole = text.rfind('\n').map_or("", |end| &text[..end]);
    let mut lines: Vec<MetricsLine> = Vec::new();
    for (index, line) in whole.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let mut line: MetricsLine = serde_json::from_str(line)
            .map_err(|error| FieldError::new(format!("metrics.jsonl line {}", index + 1), error.to_string()))?;
        // The last line of a run only evaluates, under the number of the iteration before it.
        if let Some(last) = lines.last().filter(|last| last.iteration == line.iteration) {
            for (key, value) in &last.values {
                let own = line.values.entry(key).or_insert(Value::Null);
                if own.is_null() {
                    own.clone_from(value);
                }
            }
        }
        while lines.last().is_some_and(|last| last.iteration >= line.iteration) {
            lines.pop();
        }
        lines.push(line);
    }
    if lines.is_empty() { Err(empty()) } else { Ok(lines) }
}

fn empty() -> FieldError {
    FieldError::new("metrics.jsonl", "no iterations yet; wait for the first one to finish")
}

struct Panel {
    title: String,
    scale: Scale,
    series: Vec<Series>,
}

struct Series {
    label: &'static str,
    colour: &'static str,
    /// `[joint steps, value]`
    points: Vec<[f64; 2]>,
}

impl Panel {
    /// The plot of a metric, if it has one and the run has the metric.
    fn of(metric: &Metric, lines: &[MetricsLine]) -> Option<Self> {
        let scale = metric.plot?;
        let sampled = metric.sampled.map(|key| ("sampled, training episodes", BLUE, key));
        let greedy = metric.greedy().then_some(("greedy evaluation", GREEN, metric.name));
        let series = sampled.into_iter().chain(greedy);
        let series = series.map(|(label, colour, key)| Series { label, colour, points: points(lines, key) });
        let series: Vec<Series> = series.collect();
        let measured = series.iter().flat_map(|one| &one.points).any(|&[_, value]| value != 0.0);
        let title = format!("{}, {}", metric.label, metric.unit);
        (measured || metric.scope == Scope::EveryTask).then_some(Self { title, scale, series })
    }

    fn height(&self) -> f64 {
        if self.scale == Scale::Share { 220.0 } else { 130.0 }
    }
}

const WIDTH: f64 = 960.0;
/// Edges of the plots.
const LEFT: f64 = 76.0;
const RIGHT: f64 = 932.0;
/// Height of the picture's title.
const HEADER: f64 = 64.0;
/// Height of a panel's title, and of the gap below its plot.
const TITLE: f64 = 32.0;
const GAP: f64 = 10.0;
/// Height of the labels of the shared horizontal axis.
const FOOTER: f64 = 52.0;
const INK: &str = "#1b1f27";
const SOFT: &str = "#667085";
const GRID: &str = "#e4e7ec";
const BLUE: &str = "#2f6fde";
const GREEN: &str = "#1d9a62";

/// The picture of at least one line as SVG text. `title` is the run's name, `subtitle` its configuration in one line.
pub fn curve_svg(title: &str, subtitle: &str, lines: &[MetricsLine]) -> Result<String, FieldError> {
    let last = lines.last().ok_or_else(empty)?.joint_env_steps.max(1) as f64;
    let panels: Vec<Panel> = METRICS.iter().filter_map(|metric| Panel::of(metric, lines)).collect();
    let height = HEADER + FOOTER + panels.iter().map(|panel| TITLE + panel.height() + GAP).sum::<f64>();
    let mut svg = Svg(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" viewBox=\"0 0 {WIDTH} {height}\" \
         role=\"img\" font-family=\"Inter, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif\" font-size=\"13\">\n\
         <title>Learning curves of {}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n",
        escape(title)
    ));
    svg.text([24.0, 34.0], "start", INK, "font-size=\"22\" font-weight=\"600\"", title);
    svg.text([24.0, 54.0], "start", SOFT, "", subtitle);
    let x = Axis { from: 0.0, to: last, start: LEFT, end: RIGHT };
    let mut top = HEADER;
    for panel in &panels {
        svg.panel(panel, &x, top + TITLE);
        top += TITLE + panel.height() + GAP;
    }
    for tick in ticks(0.0, last, 8) {
        svg.text([x.at(tick), top + 8.0], "middle", SOFT, "", &short_count(tick));
    }
    svg.text([f64::midpoint(LEFT, RIGHT), top + 34.0], "middle", INK, "", "joint environment steps");
    svg.0 += "</svg>\n";
    Ok(svg.0)
}

/// Values from..to as pixels start..end.
struct Axis {
    from: f64,
    to: f64,
    start: f64,
    end: f64,
}

impl Axis {
    fn at(&self, value: f64) -> f64 {
        self.start + (value - self.from) / (self.to - self.from) * (self.end - self.start)
    }
}

struct Svg(String);

impl Svg {
    fn text(&mut self, [x, y]: [f64; 2], anchor: &str, colour: &str, style: &str, text: &str) {
        let text = escape(text);
        // Writing to a string cannot fail.
        let _ = writeln!(
            self.0,
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"{colour}\" {style}>{text}</text>"
        );
    }

    fn line(&mut self, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        let _ =
            writeln!(self.0, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{GRID}\"/>");
    }

    fn panel(&mut self, panel: &Panel, x: &Axis, top: f64) {
        let (low, high) = limits(panel.scale, &panel.series);
        let bottom = top + panel.height();
        let y = Axis { from: low, to: high, start: bottom, end: top };
        let rows = ticks(low, high, if panel.scale == Scale::Share { 6 } else { 4 });
        let decimals = decimals(rows.get(1).map_or(high - low, |second| second - rows[0]));
        for &tick in &rows {
            self.line([LEFT, y.at(tick)], [RIGHT, y.at(tick)]);
            self.text([LEFT - 8.0, y.at(tick) + 4.5], "end", SOFT, "", &format!("{tick:.decimals$}"));
        }
        for tick in ticks(x.from, x.to, 8) {
            self.line([x.at(tick), top], [x.at(tick), bottom]);
        }
        self.text([24.0, top - 12.0], "start", INK, "font-size=\"15\"", &panel.title);
        for one in &panel.series {
            self.curve(one, x, &y);
        }
        self.legend(&panel.series, top - 12.0);
    }

    /// A line through the points; with dots where they are few.
    fn curve(&mut self, Series { points, colour, .. }: &Series, x: &Axis, y: &Axis) {
        let dots = points.len() <= 60;
        let width = if dots { 2.0 } else { 1.2 };
        let places: Vec<[f64; 2]> = points.iter().map(|&[step, value]| [x.at(step), y.at(value)]).collect();
        let path: Vec<String> = places.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        let _ = writeln!(
            self.0,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"/>",
            path.join(" ")
        );
        for [x, y] in places.iter().filter(|_| dots) {
            let _ = writeln!(self.0, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.6\" fill=\"{colour}\"/>");
        }
    }

    /// Label and last value of every series, aligned right in the head of the panel.
    fn legend(&mut self, series: &[Series], y: f64) {
        let _ = write!(self.0, "<text x=\"{RIGHT}\" y=\"{y:.1}\" text-anchor=\"end\">");
        for (k, Series { label, colour, points }) in series.iter().enumerate() {
            let label = if series.len() > 1 { label } else { "last" };
            let value = points.last().map_or("no data yet".to_owned(), |&[_, value]| short(value));
            let gap = if k == 0 { "" } else { " dx=\"24\"" };
            let _ = write!(self.0, "<tspan fill=\"{colour}\"{gap}>━ {label} {value}</tspan>");
        }
        self.0 += "</text>\n";
    }
}

/// `[joint steps, value]` of every line that has a finite value.
fn points(lines: &[MetricsLine], key: &str) -> Vec<[f64; 2]> {
    let place = |line: &MetricsLine| Some([line.joint_env_steps as f64, line.get(key).filter(|y| y.is_finite())?]);
    lines.iter().filter_map(place).collect()
}

fn limits(scale: Scale, series: &[Series]) -> (f64, f64) {
    let values = || series.iter().flat_map(|one| &one.points).map(|&[_, y]| y);
    let largest = values().fold(f64::NEG_INFINITY, f64::max);
    let smallest = values().fold(f64::INFINITY, f64::min);
    if !largest.is_finite() {
        return if scale == Scale::FromOne { (1.0, 2.0) } else { (0.0, 1.0) };
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

/// About `count` round values (1, 2 or 5 times a power of ten apart) in low..=high.
fn ticks(low: f64, high: f64, count: u32) -> Vec<f64> {
    let rough = (high - low) / f64::from(count);
    let power = 10f64.powf(rough.log10().floor());
    let step =
        [1.0, 2.0, 5.0].into_iter().map(|k| k * power).find(|&step| step >= rough * 0.999).unwrap_or(10.0 * power);
    let (first, last) = ((low / step - 1e-9).ceil() as i64, (high / step + 1e-9).floor() as i64);
    (first..=last).map(|k| k as f64 * step).collect()
}

/// Digits after the point that tell labels apart that differ by `step`.
fn decimals(step: f64) -> usize {
    (0..4).find(|&digits| step >= 0.999 * 10f64.powi(-digits)).unwrap_or(4) as usize
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
fn short_count(value: f64) -> String {
    let (scaled, suffix) = match value {
        v if v >= 1e9 => (v / 1e9, "G"),
        v if v >= 1e6 => (v / 1e6, "M"),
        v if v >= 1e3 => (v / 1e3, "k"),
        v => (v, ""),
    };
    let text = format!("{scaled:.2}");
    format!("{}{suffix}", text.trim_end_matches('0').trim_end_matches('.'))
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = r#"{"iteration":0,"joint_env_steps":1000,"success_rate":null,"reward":-1.5,"loss":3}"#;

    #[test]
    fn a_metrics_file_is_read_as_it_is_written() {
        let again = LINE.replace("null", "0.25");
        let next = LINE.replace("\"iteration\":0", "\"iteration\":1");
        let lines = parse_metrics(&format!("{LINE}\n{next}\n{again}\n\n{next}\n{{\"iter")).unwrap();
        assert_eq!(lines.len(), 2, "the resumed iterations replace the old ones");
        let [success, cost, reward] = ["success_rate", "cost_ratio", "reward"].map(|key| lines[0].get(key));
        assert_eq!((success, cost, reward), (Some(0.25), None, Some(-1.5)));
        assert_eq!(parse_metrics(""), Err(empty()));
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
        let lines = parse_metrics(&(line("0.5", "0.25") + &line("0.75", "null"))).unwrap();
        assert_eq!(lines.len(), 1);
        let values = ["success_rate", "sampled_success_rate"].map(|key| lines[0].get(key));
        assert_eq!(values, [Some(0.75), Some(0.25)]);
    }

    #[test]
    fn every_curve_can_be_drawn_and_text_is_escaped() {
        let svg = curve_svg("a <run> & more", "N = 5", &parse_metrics(&format!("{LINE}\n")).unwrap()).unwrap();
        assert!(svg.contains("a &lt;run&gt; &amp; more") && svg.contains("no data yet") && svg.ends_with("</svg>\n"));
        let text: String = (1..300u64)
            .map(|k| {
                let (steps, success) = (1000 + 10_000 * k, if k % 10 == 0 { "0.5" } else { "null" });
                format!(
                    "{{\"iteration\":{k},\"joint_env_steps\":{steps},\"success_rate\":{success},\
                     \"sampled_success_rate\":{},\"collisions_per_agent_step\":0.0,\"cost_ratio\":1.0,\"arrival_step\":120}}\n",
                    k as f64 / 300.0
                )
            })
            .collect();
        let svg = curve_svg("run", "", &parse_metrics(&text).unwrap()).unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf") && svg.contains("joint environment steps"));
        assert_eq!((svg.matches("<polyline").count(), svg.matches("<circle").count()), (8, 29));
        assert!(svg.contains("arrival, steps") && !svg.contains("second cost"), "no panel without the metric");
        assert_eq!(curve_svg("run", "", &[]), Err(empty()));
    }

    #[test]
    fn ticks_are_round_and_inside_the_axis() {
        assert_eq!(ticks(0.0, 1.0, 6), [0.0, 0.2, 0.4, 0.6000000000000001, 0.8, 1.0]);
        assert_eq!(ticks(0.0, 96_000.0, 8), [0.0, 20_000.0, 40_000.0, 60_000.0, 80_000.0]);
        assert_eq!((decimals(0.2), decimals(20.0), decimals(0.05), decimals(0.01)), (1, 0, 2, 2));
    }

    #[test]
    fn step_counts_are_short() {
        for (value, text) in [(0.0, "0"), (500.0, "500"), (250_000.0, "250k"), (1_500_000.0, "1.5M"), (2e9, "2G")] {
            assert_eq!(short_count(value), text);
        }
    }
}
