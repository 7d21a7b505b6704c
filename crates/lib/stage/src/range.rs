//! Parsers for options whose numbers have a range: clap then refuses a wrong one before anything is read, and a stage needs
//! no checks of its own.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::str::FromStr;

/// A number in `range`, ends included, as in `#[arg(long, value_parser = stage::within(0.0..=1.0))]`.
pub fn within<T>(range: RangeInclusive<T>) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static
where
    T: FromStr + PartialOrd + Display + Clone + Send + Sync + 'static,
{
    let expected = format!("{} to {}", range.start(), range.end());
    move |text| number(text, |v| range.contains(v), &expected)
}

/// A finite number of at least `least`.
pub fn at_least<T>(least: T) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static
where
    T: FromStr + PartialOrd + Display + Clone + Into<f64> + Send + Sync + 'static,
{
    let expected = format!("{least} or more");
    move |text| number(text, |v: &T| *v >= least && v.clone().into().is_finite(), &expected)
}

/// A finite number above 0.
pub fn positive<T>(text: &str) -> Result<T, String>
where
    T: FromStr + Clone + Into<f64>,
{
    number(text, |v: &T| v.clone().into() > 0.0 && v.clone().into().is_finite(), "more than 0")
}

fn number<T: FromStr>(text: &str, good: impl Fn(&T) -> bool, expected: &str) -> Result<T, String> {
    text.parse().ok().filter(good).ok_or_else(|| format!("expected {expected}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_numbers_in_range_pass() {
        let share = within(0.0..=1.0);
        assert_eq!((share("0"), share("1")), (Ok(0.0), Ok(1.0)));
        for wrong in ["-0.1", "1.1", "nan", "inf", "x", ""] {
            assert_eq!(share(wrong), Err("expected 0 to 1".into()), "{wrong}");
        }
        assert_eq!(within(2usize..=512)("1"), Err("expected 2 to 512".into()));
        assert_eq!(at_least(0.0f64)("0"), Ok(0.0));
        assert!(at_least(0.0f32)("inf").is_err() && at_least(0.0f32)("-1").is_err());
        assert_eq!(positive::<f64>("0.5"), Ok(0.5));
        assert!(["0", "-1", "inf", "nan"].iter().all(|t| positive::<f64>(t).is_err()));
    }
}
