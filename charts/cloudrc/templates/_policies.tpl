{{/* Parts of NetworkPolicies. */}}

{{- define "cloudrc.dns" -}}
- to:
    {{- toYaml .Values.networkPolicy.dns | nindent 4 }}
  ports:
    - {port: {{ .Values.networkPolicy.dnsPort }}, protocol: UDP}
    - {port: {{ .Values.networkPolicy.dnsPort }}, protocol: TCP}
{{- end }}

{{/* The tunnel to or from the other end, or the cell, which has a port for each robot. Argument: (dict
     "root" $ "component" PEER "way" "from"|"to"). */}}
{{- define "cloudrc.tunnel" -}}
{{- $ports := "{port: 7400, protocol: UDP}" -}}
{{- if include "cloudrc.hasCell" .root -}}
{{- if eq .way "to" -}}
{{- $ports = eq .component "cloud" | ternary "{port: 7400, endPort: 8399, protocol: UDP}" "{port: 8400, endPort: 9399, protocol: UDP}" -}}
{{- end -}}
{{- $_ := set . "component" "cell" -}}
{{- end -}}
- {{ .way }}:
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" . | nindent 10 }}
  ports:
    - {{ $ports }}
{{- end }}

{{/* Missions, `helm test` and teleop.allowFrom call the API. */}}
{{- define "cloudrc.apiCalls" -}}
- from:
    {{- range $component := list "mission" "test" }}
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" (dict "root" $ "component" $component) | nindent 10 }}
    {{- end }}
    {{- with .Values.teleop.allowFrom }}
    {{- toYaml . | nindent 4 }}
    {{- end }}
  ports:
    - {port: 8080, protocol: TCP}
{{- end }}

{{/* `helm test` reads the metrics of world, cloud and the link containers. */}}
{{- define "cloudrc.linkTest" -}}
- from:
    - podSelector:
        matchLabels:
          {{- include "cloudrc.selector" (dict "root" . "component" "test") | nindent 10 }}
  ports:
    - {port: 9100, protocol: TCP}
    - {port: 9102, protocol: TCP}
{{- end }}

{{/* Scraping, if metrics.allowFrom is set. Argument: (dict "root" $ "ports" LIST). */}}
{{- define "cloudrc.scrape" -}}
{{- with .root.Values.metrics.allowFrom }}
- from:
    {{- toYaml . | nindent 4 }}
  ports:
    {{- range $.ports }}
    - {port: {{ . }}, protocol: TCP}
    {{- end }}
{{- end }}
{{- end }}
