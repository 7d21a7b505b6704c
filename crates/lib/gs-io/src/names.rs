//! Names that people give: they are shown in terminals, and become names of files.

use crate::{Error, Result};

/// Whether a character does something to a terminal, ends a line, or turns the text around it: no name needs one.
pub fn is_control(c: char) -> bool {
    let turns = matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || turns || matches!(c, '\u{2028}' | '\u{2029}')
}

/// A message as one line that does nothing to a terminal: names of files, and names within them, may hold line breaks and
/// other control characters, which are written as `\n` or `\u{1b}`.
pub fn escaped(message: &str) -> String {
    let one = |c: char| if is_control(c) { c.escape_default().to_string() } else { c.to_string() };
    message.chars().map(one).collect()
}

/// Checks a name that a person or another program gave: it has no control character ([`is_control`]), and no program takes it
/// for an option.
///
/// # Errors
/// When it has, or begins with a dash.
pub fn check_name(name: &str) -> Result<()> {
    if name.contains(is_control) {
        return Err(Error::new("a control character in the name").found(format!("{name:?}")));
    }
    if name.starts_with('-') {
        return Err(Error::new("the name begins with a dash").found(format!("{name:?}")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_do_nothing_to_terminals_and_programs() {
        for bad in ["a\nb", "\u{1b}[31mred", "-rf", "photo\u{202e}gpj.exe", "\u{2067}x", "a\u{2028}b", "\u{85}", "\0"] {
            assert!(check_name(bad).is_err(), "{bad:?}");
            assert!(!escaped(bad).contains(is_control), "{bad:?}");
        }
        // Persian and emoji join letters by characters that are not seen.
        for good in ["kettle", "coffee-mug", "می‌خواهم", "👩‍🍳", "קומקום", "été 2", "a (b)"] {
            check_name(good).unwrap();
            assert_eq!(escaped(good), good);
        }
    }
}
