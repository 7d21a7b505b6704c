//! Tables of published and measured figures: as Markdown, as a page, as JSON.

use crate::html::Page;
use serde_json::{Value, json};

/// A row of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The method or scene.
    pub name: String,
    /// Where the figures are printed; none for ours.
    pub source: Option<String>,
    /// A figure for each column of the table, in percent.
    pub cells: Vec<Option<f64>>,
}

impl Row {
    /// A row as `source` prints it.
    pub fn published(name: &str, source: &str, cells: Vec<Option<f64>>) -> Self {
        Self { name: name.into(), source: Some(source.into()), cells }
    }

    /// A row of ours.
    pub fn measured(name: &str, cells: Vec<Option<f64>>) -> Self {
        Self { name: name.into(), source: None, cells }
    }
}

/// Figures by row and column.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// What its rows are.
    pub head: String,
    /// Names of the columns of figures.
    pub columns: Vec<String>,
    /// Its rows.
    pub rows: Vec<Row>,
    /// Whether a last column says where the figures come from; ours then stand out.
    pub sources: bool,
}

impl Table {
    fn head(&self) -> Vec<&str> {
        let columns = [&self.head].into_iter().chain(&self.columns).map(String::as_str);
        columns.chain(self.sources.then_some("source")).collect()
    }

    fn rows(&self, ours: impl Fn(&str) -> String) -> Vec<Vec<String>> {
        let row = |r: &Row| {
            let name = if self.sources && r.source.is_none() { ours(&r.name) } else { r.name.clone() };
            let figure = |v: &Option<f64>| v.map_or("–".into(), |v| format!("{v:.2}"));
            let source = self.sources.then(|| r.source.clone().unwrap_or_else(|| "measured".into()));
            [name].into_iter().chain(r.cells.iter().map(figure)).chain(source).collect()
        };
        self.rows.iter().map(row).collect()
    }

    fn markdown(&self) -> String {
        markdown(&self.head(), &self.rows(|name| format!("**{name}**")))
    }

    fn json(&self) -> Value {
        let row = |r: &Row| {
            let cells = self.columns.iter().cloned().zip(r.cells.iter().map(|c| json!(c)));
            json!({"name": r.name, "source": r.source.as_deref().unwrap_or("measured"), "percent": Value::Object(cells.collect())})
        };
        json!({"title": self.title, "columns": self.columns, "rows": self.rows.iter().map(row).collect::<Vec<_>>()})
    }
}

/// A table with what belongs to it.
#[derive(Debug, Clone, PartialEq)]
pub struct Sheet {
    /// The benchmark.
    pub title: String,
    /// The paper's table with ours.
    pub table: Table,
    /// Sentences below it.
    pub remarks: Vec<String>,
    /// Notes on rules and files.
    pub notes: Vec<String>,
    /// Further tables.
    pub more: Vec<Table>,
}

impl Sheet {
    /// All of it as Markdown.
    pub fn markdown(&self) -> String {
        let mut out = self.table.markdown();
        let lines = |of: &[String], mark: &str| of.iter().map(|l| format!("{mark}{l}\n")).collect::<String>();
        if !self.remarks.is_empty() {
            out += &format!("\n{}", lines(&self.remarks, ""));
        }
        out += &format!("\n{}", lines(&self.notes, "- "));
        self.more.iter().for_each(|t| out += &format!("\n{}", t.markdown()));
        out
    }

    /// All of it as a page that asks nothing of the network.
    pub fn html(&self) -> String {
        let mut page = Page::default();
        for (at, table) in [&self.table].into_iter().chain(&self.more).enumerate() {
            page.section(&format!("table-{}", at + 1), &table.title);
            page.table(&table.head(), &table.rows(|name| format!("▸ {name}")));
            if at == 0 {
                self.remarks.iter().for_each(|r| page.paragraph(r));
            }
        }
        page.section("notes", "Notes");
        self.notes.iter().for_each(|n| page.note(n));
        let whose =
            if self.table.sources { "Published figures and ours, in percent" } else { "Our figures, in percent" };
        page.finish(&self.title, whose)
    }

    /// Its tables as JSON: figures in percent by column, null where there is none.
    pub fn json(&self) -> Value {
        [&self.table].into_iter().chain(&self.more).map(Table::json).collect()
    }
}

/// A table in Markdown.
pub fn markdown(head: &[&str], rows: &[Vec<String>]) -> String {
    let head: Vec<String> = head.iter().map(|h| (*h).to_string()).collect();
    let rule = vec!["---".to_string(); head.len()];
    let cell = |c: &String| c.replace('|', "\\|");
    let line = |cells: &Vec<String>| format!("| {} |\n", cells.iter().map(cell).collect::<Vec<_>>().join(" | "));
    [head, rule].iter().chain(rows).map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_says_the_same_in_every_form() {
        let rows = vec![
            Row::published("A<b>", "a paper", vec![Some(12.5), None]),
            Row::measured("ours", vec![None, Some(7.0)]),
        ];
        let table = Table {
            title: "T".into(),
            head: "Methods".into(),
            columns: vec!["x".into(), "y".into()],
            rows,
            sources: true,
        };
        let plain = Table { sources: false, ..table.clone() };
        let sheet = Sheet {
            title: "S".into(),
            table,
            remarks: vec!["a remark".into()],
            notes: vec!["a note".into()],
            more: vec![plain],
        };
        let text = sheet.markdown();
        assert!(
            text.starts_with("| Methods | x | y | source |\n| --- | --- | --- | --- |\n| A<b> | 12.50 | – | a paper |")
        );
        assert!(
            text.contains("| **ours** | – | 7.00 | measured |\n\na remark\n\n- a note\n\n| Methods | x | y |\n"),
            "{text}"
        );
        let page = sheet.html();
        for part in ["A&lt;b&gt;", "12.50", "a paper", "▸ ours", "a remark", "a note"] {
            assert!(page.contains(part), "{part}");
        }
        assert!(!page.contains("http"));
        assert_eq!(
            sheet.json()[0]["rows"][1],
            json!({"name": "ours", "source": "measured", "percent": {"x": null, "y": 7.0}})
        );
    }
}
