//! Values of options and variables as people write them: numbers, switches, files. An error says what was written and what to
//! write, in no parser's words.

use crate::exit::Failure;
use std::fmt::Display;
use std::io::ErrorKind;
use std::path::Path;
use std::str::FromStr;

/// The most threads of an option.
pub const THREADS_MAX: u64 = 4096;

/// What a text says about a whole number.
#[derive(Debug, PartialEq, Eq)]
enum Whole {
    Number(i128),
    Fraction,
    Other,
}

/// Parses whole numbers in `low..=high`, also as `1e6`, `5000.0`, `10_000`, and with `k`, `M` or `G` for thousands, millions and
/// billions.
pub fn whole<T: TryFrom<u64>>(low: u64, high: u64) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync {
    move |text| {
        let wanted = format!("write a whole number from {low} to {high}");
        let text = text.trim();
        let number = match read(text) {
            Whole::Number(number) => u64::try_from(number).ok().filter(|number| (low..=high).contains(number)),
            Whole::Fraction => return Err(format!("{text} is not a whole number; {wanted}")),
            Whole::Other => return Err(format!("'{text}' is not a number; {wanted}")),
        };
        number.and_then(|number| T::try_from(number).ok()).ok_or_else(|| format!("{text} is out of range; {wanted}"))
    }
}

/// Without rounding: decimal digits and a power of ten.
fn read(text: &str) -> Whole {
    let unsigned = text.strip_prefix(['-', '+']).unwrap_or(text);
    let (unsigned, power) = match unsigned.strip_suffix(['k', 'K', 'M', 'G']) {
        Some(rest) if unsigned.ends_with('M') => (rest, 6),
        Some(rest) if unsigned.ends_with('G') => (rest, 9),
        Some(rest) => (rest, 3),
        None => (unsigned, 0),
    };
    let (mantissa, exponent) = unsigned.split_once(['e', 'E']).unwrap_or((unsigned, "0"));
    let (before, after) = mantissa.split_once('.').unwrap_or((mantissa, "0"));
    let grouped = |part: &str| !part.starts_with('_') && !part.ends_with('_') && !part.is_empty();
    let digits: String = [before, after].concat().chars().filter(|&c| c != '_').collect();
    let (Ok(exponent), true) = (exponent.parse::<i64>(), grouped(before) && grouped(after)) else {
        return Whole::Other;
    };
    if !digits.bytes().all(|byte| byte.is_ascii_digit()) {
        return Whole::Other;
    }
    let decimals = after.bytes().filter(u8::is_ascii_digit).count() as i64;
    let significant = digits.trim_end_matches('0');
    let zeros = (digits.len() - significant.len()) as i64;
    let scale = exponent.saturating_add(power).saturating_add(zeros - decimals);
    if significant.is_empty() {
        return Whole::Number(0);
    }
    if scale < 0 {
        return Whole::Fraction;
    }
    let power = u32::try_from(scale).ok().and_then(|scale| 10_i128.checked_pow(scale));
    let size = significant.parse::<i128>().ok().zip(power).and_then(|(number, power)| number.checked_mul(power));
    let size = size.unwrap_or(i128::MAX);
    Whole::Number(if text.starts_with('-') { -size } else { size })
}

/// Parses decimal numbers in `low..=high`.
pub fn number<T: FromStr + PartialOrd + Display + Copy + Send + Sync>(
    low: T,
    high: T,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync {
    move |text| {
        let wanted = format!("write a number from {low} to {high}");
        let text = text.trim();
        let number: T = text.replace('_', "").parse().map_err(|_| format!("'{text}' is not a number; {wanted}"))?;
        let inside = number >= low && number <= high;
        if inside { Ok(number) } else { Err(format!("{text} is out of range; {wanted}")) }
    }
}

/// Parses what a variable says about a switch.
///
/// # Errors
/// It is none of the usual words.
pub fn switch(text: &str) -> Result<bool, String> {
    match text.trim().to_ascii_lowercase().as_str() {
        "1" | "true" | "yes" | "on" => Ok(true),
        "0" | "false" | "no" | "off" => Ok(false),
        _ => Err(format!("'{text}' is neither yes nor no; write true or false (1/0, yes/no and on/off mean the same)")),
    }
}

/// Reads the text file that an option names.
///
/// # Errors
/// It cannot be read: [`Failure::usage`], which names the option, the file and the remedy.
pub fn text_file(option: &str, path: &Path) -> Result<String, Failure> {
    let wrong = |problem: &str| Failure::usage(format!("{option} {}: {problem}", path.display()).trim_start());
    let bytes = std::fs::read(path).map_err(|error| wrong(&unreadable(&error)))?;
    String::from_utf8(bytes).map_err(|_| wrong("is not a text file (UTF-8)"))
}

/// Where a TOML text is wrong and how, in plain words.
pub(crate) fn toml_problem(text: &str, error: &toml::de::Error) -> String {
    let message = error.message().trim().replace('`', "'").replace("expected one of", "use one of");
    let problem = match message.strip_prefix("missing field ") {
        Some(key) => format!("{key} is missing"),
        None if message.starts_with("invalid type") => "a value of another kind belongs here".to_owned(),
        None => message.replace("unknown field", "unknown key").replace("unknown variant", "unknown name"),
    };
    let before = error.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
    format!("line {}: {problem}", before.matches('\n').count() + 1)
}

/// Why a file could not be read.
pub fn unreadable(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::NotFound => "there is no such file".to_owned(),
        ErrorKind::IsADirectory => "is a folder; give a file".to_owned(),
        ErrorKind::NotADirectory => "a part of this path is a file, not a folder".to_owned(),
        ErrorKind::PermissionDenied => "permission denied; this user may not read it".to_owned(),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_are_read_as_people_write_them() {
        let parse = whole::<u64>(0, i64::MAX as u64);
        for (text, number) in [
            ("0", 0),
            ("-0", 0),
            ("+7", 7),
            ("1e6", 1_000_000),
            ("1E6", 1_000_000),
            ("1.5e3", 1500),
            ("5000.0", 5000),
            ("2500e-2", 25),
            ("10_000", 10_000),
            ("5M", 5_000_000),
            ("2.5k", 2500),
            ("3G", 3_000_000_000),
            (" 12 ", 12),
            ("9223372036854775807", i64::MAX as u64),
        ] {
            assert_eq!(parse(text), Ok(number), "{text}");
        }
        for (text, words) in [
            ("5000.5", "5000.5 is not a whole number; write a whole number from 0"),
            ("1e-1", "not a whole number"),
            ("-1", "-1 is out of range"),
            ("9223372036854775808", "out of range"),
            ("99999999999999999999999999999999999999999999", "out of range"),
            ("1e99999999999", "out of range"),
            ("five", "'five' is not a number"),
            ("", "'' is not a number"),
            ("1__0_", "not a number"),
            ("_1", "not a number"),
            (".5", "not a number"),
            ("0x10", "not a number"),
            ("5m", "not a number"),
            ("1e", "not a number"),
            ("é", "not a number"),
            ("NaN", "not a number"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.contains(words), "{text}: {error}");
        }
        assert_eq!(whole::<u8>(0, 1000)("300"), Err("300 is out of range; write a whole number from 0 to 1000".into()));
    }

    #[test]
    fn decimal_numbers_have_a_range() {
        let parse = number::<f32>(0.0, 2.0);
        assert_eq!((parse("0.995"), parse("1e-1")), (Ok(0.995), Ok(0.1)));
        for text in ["90%", "nan", "inf", "-0.1", "2.1", ""] {
            let error = parse(text).unwrap_err();
            assert!(error.ends_with("write a number from 0 to 2") && error.contains(text), "{text}: {error}");
        }
    }

    #[test]
    fn switches_are_words_in_any_case() {
        for (yes, no) in [("1", "0"), ("true", "FALSE"), ("Yes", "no"), ("ON", "off")] {
            assert_eq!((switch(yes), switch(no)), (Ok(true), Ok(false)));
        }
        assert!(switch("maybe").unwrap_err().contains("'maybe'"));
    }

    #[test]
    fn files_that_cannot_be_read_are_named_with_what_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let noise = folder.path().join("noise");
        std::fs::write(&noise, [0xff, 0xfe, 0x00]).unwrap();
        for (path, words) in [
            (folder.path().to_owned(), "is a folder"),
            (folder.path().join("none"), "no such file"),
            (noise.join("below"), "is a file, not a folder"),
            (noise, "not a text file"),
        ] {
            let error = text_file("--config", &path).unwrap_err();
            let named = error.message.starts_with("--config ") && error.message.contains(words);
            assert!(named && error.code == crate::exit::USAGE, "{error}");
        }
    }
}
