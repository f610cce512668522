{{/* A dashboard of Grafana as YAML. Argument: topic, panels, isFleet, and name and namespace of the release. */}}
{{- define "cloudrc.dashboard" -}}
uid: {{ printf "cloudrc-%s-%s" .topic (printf "%s/%s" .namespace .name | sha256sum | trunc 12) }}
title: {{ printf "%s (%s/%s)" (title .topic) .namespace .name | quote }}
tags: [cloudrc]
schemaVersion: 39
refresh: 5s
time: {from: now-15m, to: now}
links: [{type: dashboards, title: cloudrc, tags: [cloudrc], asDropdown: true, keepTime: true}]
templating:
  list:
    - {name: datasource, label: Data source, type: datasource, query: prometheus}
    - name: namespace
      {{- include "cloudrc.variable" (list "label_values(cloudrc_build_info, namespace)" .namespace) | nindent 6 }}
    - name: release
      {{- if .isFleet }}
      {{- include "cloudrc.variable" (list "label_values(cloudrc_build_info{namespace=~\"$namespace\"}, release)" .name) | nindent 6 }}
    - name: robot
      {{- include "cloudrc.variable" (list "label_values(cloudrc_build_info{release=~\"$release\"}, robot)" "$__all") | nindent 6 }}
      {{- else }}
      regex: /^(.*)-(?:world|cloud)-[^-]+-[^-]+$/
      {{- include "cloudrc.variable" (list "label_values(cloudrc_build_info{namespace=~\"$namespace\"}, pod)" .name) | nindent 6 }}
      {{- end }}
panels:
  {{- range $i, $panel := .panels }}
  - id: {{ add1 $i }}
    title: {{ $panel.title | quote }}
    type: {{ hasKey $panel "states" | ternary "state-timeline" "timeseries" }}
    datasource: {type: prometheus, uid: "${datasource}"}
    gridPos: {x: {{ mul 8 (mod $i 3) }}, "y": {{ mul 8 (div $i 3) }}, w: 8, h: 8}
    fieldConfig:
      overrides: []
      defaults:
        unit: {{ $panel.unit | default "none" }}
        {{- with $panel.states }}
        mappings:
          - type: value
            options:
              {{- range $value, $state := . }}
              {{ $value | quote }}: {index: {{ $value }}, text: {{ index $state 0 | quote }}, color: {{ index $state 1 }}}
              {{- end }}
        {{- end }}
    targets:
      {{- range $legend, $query := $panel.queries }}
      - {refId: {{ $legend | quote }}, legendFormat: {{ printf "%s%s" $legend ($.isFleet | ternary " {{robot}}" "") | quote }}, expr: {{ $query | quote }}}
      {{- end }}
  {{- end }}
{{- end }}

{{/* A variable whose values a query lists. Argument: the query, and the selected value. All also matches
     metrics without the label, whatever a query puts behind the variable. */}}
{{- define "cloudrc.variable" -}}
type: query
datasource: {type: prometheus, uid: "${datasource}"}
query: {query: {{ index . 0 | quote }}, refId: values}
refresh: 2
includeAll: true
allValue: ".*|"
current: {text: {{ index . 1 | quote }}, value: {{ index . 1 | quote }}}
{{- end }}
