//! A self-contained HTML page: pictures inside as base64, no scripts, no requests.

use base64::Engine as _;
use std::fmt::Write;

/// Text made safe inside HTML, also in attributes.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            c => out.push(c),
        }
    }
    out
}

/// A page under construction.
#[derive(Debug, Default)]
pub struct Page {
    body: String,
    sections: Vec<(String, String)>,
}

/// A picture with what is written under it.
#[derive(Debug, Clone)]
pub struct Figure {
    /// A JPEG file.
    pub jpeg: Vec<u8>,
    /// Caption, plain text.
    pub caption: String,
}

impl Page {
    /// Begins a section; `id` is its anchor.
    pub fn section(&mut self, id: &str, title: &str) {
        self.sections.push((id.into(), title.into()));
        let _ = write!(self.body, r#"<h2 id="{}">{}</h2>"#, escape(id), escape(title));
    }

    /// A heading within a section, with a remark beside it.
    pub fn heading(&mut self, title: &str, remark: &str) {
        let _ = write!(self.body, "<h3>{} <span>{}</span></h3>", escape(title), escape(remark));
    }

    /// A paragraph of plain text.
    pub fn paragraph(&mut self, text: &str) {
        let _ = write!(self.body, "<p>{}</p>", escape(text));
    }

    /// A paragraph of plain text with a link at its end.
    pub fn link(&mut self, text: &str, url: &str) {
        let url = escape(url);
        let _ = write!(self.body, r#"<p>{} <a href="{url}">{url}</a></p>"#, escape(text));
    }

    /// A remark, set apart: what was left out and why.
    pub fn note(&mut self, text: &str) {
        let _ = write!(self.body, r#"<p class="note">{}</p>"#, escape(text));
    }

    /// Pictures in rows of `columns` beside each other.
    pub fn figures(&mut self, columns: usize, figures: &[Figure]) {
        if figures.is_empty() {
            return;
        }
        let _ = write!(self.body, r#"<div class="figures" style="--columns:{columns}">"#);
        for f in figures {
            let data = base64::engine::general_purpose::STANDARD.encode(&f.jpeg);
            let caption = escape(&f.caption);
            let _ = write!(
                self.body,
                r#"<figure><img alt="{caption}" src="data:image/jpeg;base64,{data}"><figcaption>{caption}</figcaption></figure>"#
            );
        }
        self.body += "</div>";
    }

    /// Charts (SVG elements) beside each other.
    pub fn charts(&mut self, charts: &[String]) {
        let _ = write!(self.body, r#"<div class="charts">{}</div>"#, charts.concat());
    }

    /// Facts as tiles: a large value over its name.
    pub fn tiles(&mut self, facts: &[(String, String)]) {
        self.body += r#"<div class="tiles">"#;
        for (name, value) in facts {
            let _ = write!(self.body, "<div><b>{}</b><span>{}</span></div>", escape(value), escape(name));
        }
        self.body += "</div>";
    }

    /// A table; cells that read as numbers are set to the right.
    pub fn table(&mut self, head: &[&str], rows: &[Vec<String>]) {
        self.body += r#"<div class="wide"><table><thead><tr>"#;
        let number = |s: &str| s.starts_with(|c: char| c.is_ascii_digit() || c == '-' || c == '–');
        let right = |column: usize| !rows.is_empty() && rows.iter().all(|r| r.get(column).is_some_and(|c| number(c)));
        for (i, h) in head.iter().enumerate() {
            let _ = write!(self.body, "<th{}>{}</th>", if right(i) { r#" class="n""# } else { "" }, escape(h));
        }
        self.body += "</tr></thead><tbody>";
        for row in rows {
            self.body += "<tr>";
            for (i, cell) in row.iter().enumerate() {
                let _ = write!(self.body, "<td{}>{}</td>", if right(i) { r#" class="n""# } else { "" }, escape(cell));
            }
            self.body += "</tr>";
        }
        self.body += "</tbody></table></div>";
    }

    /// The finished document.
    pub fn finish(self, title: &str, subtitle: &str) -> String {
        let links: Vec<String> = self
            .sections
            .iter()
            .map(|(id, title)| format!(r##"<a href="#{}">{}</a>"##, escape(id), escape(title)))
            .collect();
        format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
             <meta name=\"color-scheme\" content=\"light dark\"><title>{title}</title><style>{STYLE}</style></head>\
             <body><header><h1>{title}</h1><p>{subtitle}</p><nav>{}</nav></header><main>{}</main></body></html>\n",
            links.concat(),
            self.body,
            title = escape(title),
            subtitle = escape(subtitle),
        )
    }
}

const STYLE: &str = include_str!("page.css");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_break_the_page() {
        let mut p = Page::default();
        p.section("a\"b", "<script>alert(1)</script>");
        p.table(&["query", "IoU"], &[vec!["<b>&'\"".into(), "0.5".into()]]);
        p.figures(2, &[Figure { jpeg: vec![1, 2, 3], caption: "x\"><img src=http://e>".into() }]);
        let html = p.finish("t<", "s");
        assert!(
            !html.contains("<script")
                && !html.contains("<img src=http")
                && html.contains("data:image/jpeg;base64,AQID")
        );
        assert!(html.contains("&lt;b&gt;&amp;&#39;&quot;") && html.contains(r#"<td class="n">0.5</td>"#));
    }
}
